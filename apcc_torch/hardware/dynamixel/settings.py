"""What a bus of Dynamixel motors needs to be told, in SI units."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from math import ceil, inf, isfinite

from apcc_torch.errors import ValueRangeError
from apcc_torch.hardware.dynamixel.registers import (
    ACCELERATION_UNIT,
    CURRENT_UNIT,
    MAX_CURRENT_TICKS,
    MAX_PROFILE_TICKS,
    OPERATING_MODES,
    VELOCITY_UNIT,
    WATCHDOG_UNIT,
)

MAX_ID = 252
MAX_WATCHDOG_TICKS = 127


def _in_range(name: str, value: float, low: float, high: float) -> None:
    if not (isfinite(value) and low < value <= high):
        raise ValueRangeError(f"{name} must be over {low:g} and at most {high:g}, got {value}")


def _check_id(name: str, value: int) -> None:
    if isinstance(value, bool) or not isinstance(value, int) or not 0 <= value <= MAX_ID:
        raise ValueRangeError(f"{name} must be a whole number from 0 to {MAX_ID}, got {value!r}")


@dataclass(frozen=True)
class GripperSettings:
    """A gripper's motor on the same bus. It turns less than once, so its encoder's own zero is enough.

    id: On the bus. open_angle, closed_angle: rad of the encoder, in [0, 2 pi). current_limit: A. tolerance: rad that
    it may stand beyond either end when it is armed.
    """

    id: int
    open_angle: float
    closed_angle: float
    current_limit: float = 0.3
    tolerance: float = 0.1

    def __post_init__(self) -> None:
        """Raises ValueRangeError for a value without meaning."""
        _check_id("gripper.id", self.id)
        for name in ("open_angle", "closed_angle"):
            if not 0 <= getattr(self, name) < 6.28:
                raise ValueRangeError(f"gripper.{name} must be in [0, 2 pi) rad, got {getattr(self, name)}")
        if abs(self.open_angle - self.closed_angle) < 0.01:
            raise ValueRangeError("gripper.open_angle and closed_angle must differ by 0.01 rad or more")
        _in_range("gripper.current_limit", self.current_limit, 0, MAX_CURRENT_TICKS * CURRENT_UNIT)
        _in_range("gripper.tolerance", self.tolerance, 0, 1)


@dataclass(frozen=True)
class DynamixelSettings:
    """Motors, spools and limits. A tendon's entry is at the same place in every list.

    port: Serial device. ids: On the bus, a motor each tendon. spool_radii: m, to the tendon's centre line. signs: +1
    where positive rotation lengthens the tendon, -1 where it pulls it in. lower, upper: m, the range of length changes
    that may be commanded. baud: bit/s, as the motors are set. mode: "current_based_position", which limits the
    tension by the current, or "extended_position". current_limit: A. profile_velocity: rad/s, profile_acceleration:
    rad/s^2 of the motors' own trajectory to a goal. bus_watchdog: s without a packet after which a motor stops by
    itself; rounded up to 20 ms. reply_timeout: s, on top of the time on the line. torque_constant: N m/A at the
    output; 1.3 is the XM430-W210's stall torque over its stall current, so tensions are estimates. zero_tolerance: m
    that a tendon may be out of its range when it is armed. release_torqued: Whether connecting lets go of motors that
    hold torque; False refuses them. gripper: None if there is none.
    """

    port: str
    ids: Sequence[int]
    spool_radii: Sequence[float]
    signs: Sequence[int]
    lower: Sequence[float]
    upper: Sequence[float]
    baud: int = 1_000_000
    mode: str = "current_based_position"
    current_limit: float = 1.0
    profile_velocity: float = 4.0
    profile_acceleration: float = 40.0
    bus_watchdog: float = 0.1
    reply_timeout: float = 0.01
    torque_constant: float = 1.3
    zero_tolerance: float = 0.002
    model_number: int = 1030
    minimum_firmware: int = 38
    release_torqued: bool = False
    gripper: GripperSettings | None = None

    def __post_init__(self) -> None:
        """Raises ValueRangeError, which names the key, for a value without meaning."""
        for name in ("ids", "spool_radii", "signs", "lower", "upper"):
            values = tuple(getattr(self, name))
            if len(values) != len(self.ids) or not values:
                raise ValueRangeError(f"{name} must have one entry for each of the {len(self.ids)} ids, got {values}")
            object.__setattr__(self, name, values)
        self._check_tendons()
        if self.mode not in OPERATING_MODES:
            raise ValueRangeError(f"mode must be one of {', '.join(OPERATING_MODES)}, got {self.mode!r}")
        _in_range("baud", self.baud, 0, 4_500_000)
        _in_range("current_limit", self.current_limit, CURRENT_UNIT, MAX_CURRENT_TICKS * CURRENT_UNIT)
        # Zero would mean as fast as the motor can; and one unit is the least that is not rounded to zero.
        _in_range("profile_velocity", self.profile_velocity, VELOCITY_UNIT, MAX_PROFILE_TICKS * VELOCITY_UNIT)
        highest = MAX_PROFILE_TICKS * ACCELERATION_UNIT
        _in_range("profile_acceleration", self.profile_acceleration, ACCELERATION_UNIT, highest)
        _in_range("bus_watchdog", self.bus_watchdog, 0, MAX_WATCHDOG_TICKS * WATCHDOG_UNIT)
        _in_range("reply_timeout", self.reply_timeout, 0, 1)
        _in_range("torque_constant", self.torque_constant, 0, inf)
        _in_range("zero_tolerance", self.zero_tolerance, 0, 0.05)

    def _check_tendons(self) -> None:
        ids = [*self.ids, *([self.gripper.id] if self.gripper else [])]
        for motor in self.ids:
            _check_id("ids", motor)
        if len(set(ids)) != len(ids):
            raise ValueRangeError(f"ids and gripper.id must all differ, got {ids}")
        for radius, sign, lower, upper in zip(self.spool_radii, self.signs, self.lower, self.upper, strict=True):
            _in_range("spool_radii", radius, 0, 0.2)
            if sign not in (-1, 1):
                raise ValueRangeError(f"signs must be -1 or 1, got {sign}")
            if not (isfinite(lower) and isfinite(upper) and lower <= 0 <= upper and lower < upper):
                raise ValueRangeError(f"lower and upper must enclose 0 and differ, got {lower} and {upper}")

    @property
    def watchdog_ticks(self) -> int:
        """The bus watchdog in its register's unit."""
        return ceil(self.bus_watchdog / WATCHDOG_UNIT - 1e-9)
