"""What can be set of a run in real time. Values and meanings stand in conf/; a wrong key or type is refused."""

from __future__ import annotations

from dataclasses import dataclass, field, fields
from typing import Any

from omegaconf import MISSING

from apcc_torch.composition.hardware import CalibrationConfig, HardwareConfig
from apcc_torch.composition.schema import ArmConfig, SimulateConfig


@dataclass
class LimitsConfig:
    """Clamps of every command: a number, or one a tendon."""

    lower: Any = MISSING
    upper: Any = MISSING
    rate: Any = 0.15
    step: Any = 5e-3


@dataclass
class SensingConfig:
    """Frames and bodies to believe."""

    max_age: float = 0.06
    stale: float = 0.2
    dropout: float = 0.3
    frozen_frames: int | None = 10
    partial: str = "skip"
    max_speed: float = 1.0
    position_margin: float = 0.01
    max_angular_rate: float = 8.0
    angle_margin: float = 0.15
    reach: float = 1.5
    max_bend: float = 3.0
    max_twist: float = 0.8


@dataclass
class GuardsConfig:
    """What ends a run."""

    limits: LimitsConfig = field(default_factory=LimitsConfig)
    sensing: SensingConfig = field(default_factory=SensingConfig)
    arrival_error: float | None = 1e-3
    arrival_dwell: float = 0.5
    max_error: float | None = 1.0
    effort_limit: float | None = None
    effort_dwell: float = 0.3
    effort_cap: float | None = None
    slack_effort: float | None = None
    slack_dwell: float = 0.5
    range_margin: float = 5e-3
    overruns: int = 10
    overrun_window: float = 1.0
    failed_exchanges: int = 5
    endings: dict[str, str] = field(default_factory=dict)


@dataclass
class LoopConfig:
    """Rate and preparation of the loop."""

    rate: float = 50.0
    spin: float = 2e-4
    warm_up: int = 50
    fresh_frames: int = 5
    fresh_timeout: float = 2.0
    arm_margin: float = 1e-3
    hold: float = 30.0
    priority: int | None = None
    lock_memory: bool = False


@dataclass
class RampConfig:
    """Where the tendons go in an experiment of kind `tendons`."""

    goal: list[float] | None = None
    duration: float = 10.0
    estimate: list[float] | None = None


@dataclass
class SeriesConfig:
    """Runs one after the other, and the study that is made of them."""

    study: str | None = None
    runs: dict[str, list[str]] = field(default_factory=dict)
    only: list[str] | None = None
    figures: bool = True


@dataclass
class RealtimeConfig(ArmConfig):
    """Root of `python -m apcc_torch.robot`."""

    hardware: HardwareConfig = field(default_factory=HardwareConfig)
    guards: GuardsConfig = field(default_factory=GuardsConfig)
    loop: LoopConfig = field(default_factory=LoopConfig)
    calibration: CalibrationConfig = field(default_factory=CalibrationConfig)
    ramp: RampConfig = field(default_factory=RampConfig)
    series: SeriesConfig = field(default_factory=SeriesConfig)
    dry_run: bool = False
    view: bool = True
    log: bool = True


def model_settings(config: RealtimeConfig) -> SimulateConfig:
    """The part of the settings that a simulation has too, as the builder of simulations takes it."""
    return SimulateConfig(**{shared.name: getattr(config, shared.name) for shared in fields(ArmConfig)})
