"""Everything one run is made of."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

from apcc_torch.errors import ConfigError
from apcc_torch.hardware.clock import Clock
from apcc_torch.hardware.control import Control
from apcc_torch.hardware.guards import GuardSettings
from apcc_torch.hardware.interfaces import PoseSensor, TendonActuator
from apcc_torch.hardware.limits import CommandLimits
from apcc_torch.hardware.records import Observer
from apcc_torch.hardware.sensing import Sensing
from apcc_torch.hardware.stop_request import StopRequest
from apcc_torch.settings import OURS, Settings, setting


@dataclass(frozen=True, kw_only=True)
class LoopSettings(Settings):
    """Rate and preparation of the loop."""

    rate: float = setting(
        50.0, "Hz", OURS, "the controller steps where a new frame has come, at most this often", least=20, most=500
    )
    warm_up: int = setting(50, "", OURS, "controller steps before torque", least=1)
    fresh_frames: int = setting(5, "", OURS, "complete frames in a row before torque", least=1)
    fresh_timeout: float = setting(2.0, "s", OURS, "that they may take", least=0)
    arm_margin: float = setting(
        1e-3, "m", OURS, "by which lengths may be out of range, or move, as torque goes on", least=0
    )
    hold: float = setting(1.0, "s", OURS, "the arm is held after a run; then torque goes off and it drops", least=0)
    priority: int | None = setting(None, "", OURS, "of SCHED_FIFO; null: the system's own scheduler", least=1, most=99)
    lock_memory: bool = setting(False, "", OURS, "keep all memory in RAM")

    @property
    def period(self) -> float:
        """s between two deadlines."""
        return 1.0 / self.rate


@dataclass(frozen=True)
class Setup:
    """The parts of a run.

    actuator, sensor: Not yet connected. sensing: Judges frames. control: The controller. limits: Clamps of every
    command. guards: What ends the run. loop: Rate and preparation. clock: Of every stamp; the devices' stamps are its
    own. duration: s, the longest run. request: Asks the run to stop. observers: Told of every tick and event. checks:
    Conditions for torque beside the runner's own, such as a confirmed calibration; each raises SafetyError. prepared:
    Called between warm-up and torque, for what must happen once everything is loaded.

    Raises:
        ConfigError: The devices do not fit the controller.
    """

    actuator: TendonActuator
    sensor: PoseSensor
    sensing: Sensing
    control: Control
    limits: CommandLimits
    guards: GuardSettings
    loop: LoopSettings
    clock: Clock
    duration: float
    request: StopRequest = field(default_factory=StopRequest)
    observers: Sequence[Observer] = ()
    checks: Sequence[Callable[[], None]] = ()
    prepared: Callable[[], None] | None = None

    def __post_init__(self) -> None:
        """Checks that the parts fit."""
        tendons, n_a = self.actuator.n_tendons, self.control.n_tendons
        if tendons != n_a or self.limits.lower.shape[0] != n_a:
            raise ConfigError(
                f"the controller has {n_a} tendons, the actuator {tendons}, the limits {self.limits.lower.shape[0]}"
            )
        if self.actuator.sets_pressure != self.control.sets_pressure:
            has, sets = ("lengths", "pressures") if self.actuator.sets_pressure else ("pressures", "lengths")
            raise ConfigError(f"the arm is driven by {has}, and the actuator sets {sets}: see arm.chambers")
        if self.sensor.n_bodies != self.control.n_bodies:
            raise ConfigError(
                f"the controller wants {self.control.n_bodies} bodies, the sensor sees {self.sensor.n_bodies}"
            )
