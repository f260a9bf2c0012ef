"""What can be set of a run in real time: the settings of its parts, and what a simulation has too."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, fields
from typing import Any

import yaml
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException

from apcc_torch.classes import Trust, check_trusted
from apcc_torch.composition.schema import (
    AdaptationConfig,
    ArmConfig,
    ControllerConfig,
    ExperimentConfig,
    FeedbackConfig,
    ModelConfig,
    PlantConfig,
    PoseFilterConfig,
    ResidualConfig,
    RobotConfig,
    SensorsConfig,
    SimulateConfig,
    VelocityFilterConfig,
)
from apcc_torch.errors import ConfigError
from apcc_torch.hardware.calibration_confirmation import ConfirmationSettings
from apcc_torch.hardware.calibration_measurement import MeasurementSettings
from apcc_torch.hardware.devices import HardwareSettings
from apcc_torch.hardware.guards import GuardSettings
from apcc_torch.hardware.ramp import RampSettings
from apcc_torch.hardware.setup import LoopSettings
from apcc_torch.reading import defaults, plain, read
from apcc_torch.settings import OURS, PAPER, Settings, setting


@dataclass(frozen=True, kw_only=True)
class CalibrationSettings(MeasurementSettings, ConfirmationSettings):
    """What a calibration measures, and what a run confirms of it and takes from it."""

    file: str | None = setting(None, meaning="to confirm and use, or to write; null: none, for a simulated arm only")
    id: str | None = setting(None, meaning="the calibration that it has to be; null: whichever is in the file")
    lengths: bool = setting(
        True, "", PAPER, "the model takes abscissae of sensors and racks, and rest lengths, from it"
    )
    length_tolerance: float = setting(0.02, "m", OURS, "by which they may differ from robot.sensors", above=0)


@dataclass(frozen=True, kw_only=True)
class SeriesSettings(Settings):
    """Runs one after the other, and the study that is made of them."""

    study: str | None = setting(None, meaning="experiment_1 or experiment_2: the table and figures made of the runs")
    runs: Mapping[str, list[str]] = setting(factory=dict, meaning="name: [key=value, ...], what differs in that run")
    only: tuple[str, ...] | None = setting(
        None, meaning="names; null: all of them. On an arm that has to be brought to rest by hand: one"
    )
    figures: bool = setting(True, meaning="draw the study's figures")


@dataclass(frozen=True, kw_only=True)
class RealtimeSettings(Settings):
    """Root of `python -m apcc_torch.robot`."""

    # What a simulation has too.
    robot: RobotConfig = field(default_factory=RobotConfig)
    model: ModelConfig = field(default_factory=ModelConfig)
    plant: PlantConfig = field(default_factory=PlantConfig)
    sensors: SensorsConfig = field(default_factory=SensorsConfig)
    feedback: FeedbackConfig = field(default_factory=FeedbackConfig)
    pose_filter: PoseFilterConfig = field(default_factory=PoseFilterConfig)
    velocity_filter: VelocityFilterConfig = field(default_factory=VelocityFilterConfig)
    controller: ControllerConfig = field(default_factory=ControllerConfig)
    adaptation: AdaptationConfig = field(default_factory=AdaptationConfig)
    residual: ResidualConfig = field(default_factory=ResidualConfig)
    experiment: ExperimentConfig = field(default_factory=ExperimentConfig)
    seed: int = setting(0, meaning="of the simulated sensors' noise")
    dtype: str = setting("float64", meaning="float64 or float32", choices=("float64", "float32"))
    compile: str = setting(
        "aot", meaning="the step as: aot, machine code (half a minute once, then kept; eager without g++); off"
    )

    hardware: HardwareSettings = setting(factory=HardwareSettings, meaning="which devices")
    guards: GuardSettings = setting(factory=GuardSettings, meaning="what ends a run")
    loop: LoopSettings = setting(factory=LoopSettings, meaning="rate and preparation of the loop")
    calibration: CalibrationSettings = setting(factory=CalibrationSettings, meaning="of the arm")
    ramp: RampSettings = setting(factory=RampSettings, meaning="of an experiment of kind tendons")
    series: SeriesSettings = setting(factory=SeriesSettings, meaning="several runs, each in a folder of its own")
    dry_run: bool = setting(False, meaning="everything but torque; the log says what would be sent")
    view: bool = setting(True, meaning="the live view, where there is a terminal")
    log: bool = setting(True, meaning="write log.mcap")


def model_settings(settings: RealtimeSettings) -> SimulateConfig:
    """The part of the settings that a simulation has too, as the builder of simulations takes it."""
    return SimulateConfig(**{shared.name: getattr(settings, shared.name) for shared in fields(ArmConfig)})


def schema() -> DictConfig:
    """What hydra composes the files of conf/ on: every group is open, for `read` knows which keys its parts have."""
    values = {name: {} if isinstance(value, dict) else value for name, value in defaults(RealtimeSettings).items()}
    node = OmegaConf.create(values)
    for name, value in values.items():
        if isinstance(value, dict):
            OmegaConf.set_struct(node[name], False)
    return node


def composed(cfg: DictConfig) -> RealtimeSettings:
    """The settings that hydra has composed.

    Raises:
        ConfigError, ValueRangeError: A key is unknown, or a value has no meaning.
    """
    try:
        values: Any = OmegaConf.to_container(cfg, resolve=True)
    except OmegaConfBaseException as error:
        raise ConfigError(str(error).splitlines()[0]) from error
    return read(values, RealtimeSettings)


def text(settings: RealtimeSettings) -> str:
    """Every setting, as a file that `from_text` reads."""
    return yaml.safe_dump(plain(settings), sort_keys=False, allow_unicode=True)


def from_text(content: str) -> RealtimeSettings:
    """The settings of a file that may come from elsewhere, such as a log's: plain values, in which nothing is resolved.

    Raises:
        ConfigError, ValueRangeError: They have no meaning, or name a class that is neither of this package nor allowed.
    """
    try:
        values = yaml.safe_load(content)
    except yaml.YAMLError as error:
        raise ConfigError(f"the settings are not a YAML file: {error}") from error
    settings = read(values, RealtimeSettings, trust=Trust.OWN)
    check_trusted("model.kind", settings.model.kind, Trust.OWN)
    return settings
