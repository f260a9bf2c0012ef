"""Everything one run is made of."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

from apcc_torch.errors import ConfigError, ValueRangeError
from apcc_torch.hardware.clock import Clock
from apcc_torch.hardware.control import Control
from apcc_torch.hardware.guards import GuardSettings
from apcc_torch.hardware.interfaces import PoseSensor, TendonActuator
from apcc_torch.hardware.limits import CommandLimits
from apcc_torch.hardware.records import Observer
from apcc_torch.hardware.sensing import Sensing
from apcc_torch.hardware.stop_request import StopRequest
from apcc_torch.settings import check_setting

RATES = (20.0, 500.0)
"""Slowest and fastest loop, Hz."""


@dataclass(frozen=True)
class LoopSettings:
    """Rate and preparation of the loop.

    rate: Hz. warm_up: Controller steps before torque. fresh_frames, fresh_timeout: So many complete frames in a row
    within the time, s, before torque. arm_margin: m by which lengths may lie outside their range, or move, at arming.
    hold: s for which the arm is held after a run; then torque goes off, and it drops.

    Raises:
        ValueRangeError: A number is out of range.
    """

    rate: float = 50.0
    warm_up: int = 50
    fresh_frames: int = 5
    fresh_timeout: float = 2.0
    arm_margin: float = 1e-3
    hold: float = 30.0

    def __post_init__(self) -> None:
        """Checks the numbers."""
        if not RATES[0] <= self.rate <= RATES[1]:
            raise ValueRangeError(f"loop.rate must be between {RATES[0]:g} and {RATES[1]:g} Hz, got {self.rate}")
        for name in ("warm_up", "fresh_frames"):
            if getattr(self, name) < 1:
                raise ValueRangeError(f"loop.{name} must be at least 1, got {getattr(self, name)}")
        for name in ("fresh_timeout", "arm_margin", "hold"):
            check_setting(f"loop.{name}", getattr(self, name), zero=True)

    @property
    def period(self) -> float:
        """s between two deadlines."""
        return 1.0 / self.rate


@dataclass(frozen=True)
class Setup:
    """The parts of a run.

    actuator, sensor: Not yet connected. sensing: Judges frames. control: The controller. limits: Clamps of every
    command. guards: What ends the run. loop: Rate and preparation. clock: Of every stamp; the devices' stamps are its
    own. request: Asks the run to stop. observers: Told of every tick and event. checks: Conditions for torque beside
    the runner's own, such as a confirmed calibration; each raises SafetyError. prepared: Called between warm-up and
    torque, for what must happen once everything is loaded.

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
    request: StopRequest = field(default_factory=StopRequest)
    observers: Sequence[Observer] = ()
    checks: Sequence[Callable[[], None]] = ()
    prepared: Callable[[], None] | None = None

    def __post_init__(self) -> None:
        """Checks that the parts fit."""
        tendons, wanted = self.actuator.n_tendons, self.control.n_tendons
        if tendons != wanted or self.limits.lower.shape[0] != wanted:
            raise ConfigError(
                f"the controller has {wanted} tendons, the actuator {tendons}, the limits {self.limits.lower.shape[0]}"
            )
        if self.sensor.n_bodies != self.control.n_bodies:
            raise ConfigError(
                f"the controller wants {self.control.n_bodies} bodies, the sensor sees {self.sensor.n_bodies}"
            )
