"""What can be set of a run in real time: the settings of its parts, and what a simulation has too."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import ClassVar

from apcc_torch.composition.run_settings import RunSettings, SimulateSettings
from apcc_torch.composition.unread import Unread, of_a_run
from apcc_torch.hardware.calibration_confirmation import ConfirmationSettings
from apcc_torch.hardware.calibration_measurement import MeasurementSettings
from apcc_torch.hardware.devices import HardwareSettings
from apcc_torch.hardware.guards import GuardSettings
from apcc_torch.hardware.limits import CommandLimits
from apcc_torch.hardware.ramp import RampSettings
from apcc_torch.hardware.setup import LoopSettings
from apcc_torch.hardware.simulated.actuator import SimulatedActuatorSettings
from apcc_torch.hardware.simulated.sensor import SimulatedSensorSettings
from apcc_torch.model.arm import Arm
from apcc_torch.native.compiled import MODES
from apcc_torch.reading import keyed
from apcc_torch.settings import OURS, PAPER, Settings, check_choice, names, setting
from apcc_torch.web_address import StreamAddress, WebAddress

BROWSER = "browser"
"""What `view` is for a page."""
FOXGLOVE = "foxglove"
"""What it is for a stream."""
SIMULATED = (SimulatedActuatorSettings, SimulatedSensorSettings)


@dataclass(frozen=True, kw_only=True)
class CalibrationSettings(MeasurementSettings, ConfirmationSettings):
    """What a calibration measures, and what a run confirms of it and takes from it."""

    file: str | None = setting(None, meaning="to confirm and use, or to write; null: none, for a simulated arm only")
    id: str | None = setting(None, meaning="the calibration that it has to be; null: whichever is in the file")
    lengths: bool = setting(
        True, "", PAPER, "the model takes abscissae of sensors and racks, and rest lengths, from it"
    )
    length_tolerance: float = setting(0.02, "m", OURS, "by which they may differ from arm.sensors", above=0)


@dataclass(frozen=True, kw_only=True)
class SeriesSettings(Settings):
    """Runs one after the other, and the study that is made of them."""

    study: str | None = setting(None, meaning="experiment_1 or experiment_2: the table and figures made of the runs")
    runs: Mapping[str, list[str]] = setting(factory=dict, meaning="name: [key=value, ...], what differs in that run")
    sampled: int = setting(
        0, "", OURS, "so many runs of experiment I with tendons and estimates drawn, instead of `runs`", least=0
    )
    only: tuple[str, ...] | None = setting(
        None, meaning="names; null: all of them. On an arm that has to be brought to rest by hand: one"
    )
    figures: bool = setting(True, meaning="draw the study's figures")


@dataclass(frozen=True, kw_only=True)
class RealtimeSettings(RunSettings):
    """Root of `python -m apcc_torch.robot`."""

    elsewhere: ClassVar[Mapping[str, str]] = dict.fromkeys(
        (name for name in names(SimulateSettings) if name not in (*names(RunSettings), "figures")),
        "python -m apcc_torch.simulate",
    )

    compile: str = setting(
        "auto",
        "",
        OURS,
        "the step as: aot, machine code, built once, then kept; auto, aot where it can be had, else off, eager torch; "
        "inductor",
        choices=MODES,
    )
    hardware: HardwareSettings = setting(factory=HardwareSettings, meaning="which devices")
    guards: GuardSettings = setting(factory=GuardSettings, meaning="what ends a run")
    loop: LoopSettings = setting(factory=LoopSettings, meaning="rate and preparation of the loop")
    calibration: CalibrationSettings = setting(factory=CalibrationSettings, meaning="of the arm")
    ramp: RampSettings = setting(factory=RampSettings, meaning="of an experiment of kind tendons")
    series: SeriesSettings = setting(factory=SeriesSettings, meaning="several runs, each in a folder of its own")
    dry_run: bool = setting(False, meaning="everything but torque; the log says what would be sent")
    view: bool | str = setting(
        True,
        meaning="the run, live: true, in the terminal, where there is one; browser, on a page; foxglove, streamed; "
        "false, nowhere",
    )
    page: WebAddress = setting(factory=WebAddress, meaning="where view=browser is served")
    stream: StreamAddress = setting(factory=StreamAddress, meaning="where view=foxglove is served")
    log: bool = setting(True, meaning="write log.mcap")
    figures: bool = setting(True, meaning="write the figures, once the run has ended")

    def check(self) -> None:
        """Raises where the clamps of the commands are no ranges of the arm's tendons."""
        super().check()
        if isinstance(self.view, str):
            check_choice("view", self.view, (BROWSER, FOXGLOVE, "true", "false"))
        limits_of(self.arm, self.guards)


def limits_of(arm: Arm, guards: GuardSettings) -> CommandLimits:
    """The clamps of every command to an arm.

    Raises:
        ConfigError, ValueRangeError: They are none of its tendons, or of its chambers.
    """
    if arm.chambers is None:
        with keyed("guards.limits"):
            return CommandLimits(arm.n_tendons, guards.limits)
    with keyed("guards.pressures"):
        return CommandLimits.of_chambers(arm.chambers.force(arm.n_sections), guards.pressures)


def of_a_realtime_run(c: RealtimeSettings) -> Unread:
    """What a run in real time does not read."""
    e = c.experiment
    yield from of_a_run(c)
    yield "controller.rate", "loop.rate is the rate here"
    yield "experiment.start_errors experiment.start_error", "an arm is one row"
    if e.kind == "tendons":
        yield "adaptation bounds controller.adaptive", "the tendons go their own way, and the rest lengths stay"
    else:
        yield "ramp", "experiment.kind is not tendons"
    if c.arm.chambers is None:
        yield "guards.pressures", "the arm has no chambers"
    else:
        yield "guards.limits guards.range_margin loop.arm_margin", "the arm has chambers: guards.pressures"
    if e.kind != "dynamic" or not e.setpoints:
        yield "guards.arrival_error guards.arrival_dwell", "there is no set-point to arrive at"
    if e.kind == "calibration":
        yield from _of_a_calibration(c)
    elif c.calibration.file is None:
        yield "calibration", "calibration.file names none"
    if not any(isinstance(device, SIMULATED) for device in (c.hardware.actuator, c.hardware.sensor)):
        yield "plant sensors", "the arm is a real one"
    if c.view != BROWSER:
        yield "page", "view is not browser"
    if c.view != FOXGLOVE:
        yield "stream", "view is not foxglove"
    if not c.series.runs and not c.series.sampled:
        yield "series", "there are no series.runs"
    if c.series.sampled:
        yield "series.runs", "series.sampled draws the runs"


def _of_a_calibration(c: RealtimeSettings) -> Unread:
    """What the measurement of a hanging arm does not read."""
    confirmed = ("id", "lengths", *names(ConfirmationSettings))
    yield _below("calibration", confirmed), "a run that uses the calibration reads it, and this one makes it"
    groups = "model feedback pose_filter velocity_filter controller adaptation bounds integral divergence"
    targets = ("setpoints", "subset", "r_0", "A", "omega", "first_estimate", "duration")
    yield f"{groups} {_below('experiment', targets)}", "a calibration runs no controller"
    loop = [name for name in names(LoopSettings) if name != "rate"]
    guards = [name for name in names(GuardSettings) if name not in ("limits", "effort_cap")]
    yield (
        f"view page stream log figures {_below('loop', loop)} {_below('guards', guards)}",
        "a calibration runs no loop",
    )
    if not c.calibration.check_signs:
        pulled = "loop.rate guards.limits guards.effort_cap calibration.pull"
        yield pulled, "calibration.check_signs is false, and no tendon is pulled"


def _below(group: str, keys: Iterable[str]) -> str:
    return " ".join(f"{group}.{key}" for key in keys)
