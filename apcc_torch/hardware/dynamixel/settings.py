"""What a bus of Dynamixel motors needs to be told, in SI units."""

from __future__ import annotations

from dataclasses import dataclass
from math import ceil, pi

from apcc_torch.errors import ConfigError, ValueRangeError
from apcc_torch.hardware.dynamixel.registers import (
    ACCELERATION_UNIT,
    CURRENT_UNIT,
    MAX_CURRENT_TICKS,
    MAX_GAIN,
    MAX_PROFILE_TICKS,
    MAX_VELOCITY_LIMIT,
    OPERATING_MODES,
    VELOCITY_UNIT,
    WATCHDOG_UNIT,
)
from apcc_torch.settings import OURS, PAPER, Settings, setting
from apcc_torch.spread import Numbers, spread

MAX_ID = 252
MAX_CURRENT = MAX_CURRENT_TICKS * CURRENT_UNIT
MAX_WATCHDOG_TICKS = 127


@dataclass(frozen=True, kw_only=True)
class GripperSettings(Settings):
    """A gripper's motor on the same bus. It turns less than once, so its encoder's own zero is enough."""

    id: int = setting(meaning="on the bus", least=0, most=MAX_ID)
    open_angle: float = setting(1.0, "rad", OURS, "of its encoder", least=0, below=2 * pi)
    closed_angle: float = setting(2.0, "rad", OURS, "of its encoder", least=0, below=2 * pi)
    current_limit: float = setting(0.3, "A", OURS, "the grip", above=0, most=MAX_CURRENT)
    tolerance: float = setting(
        0.1, "rad", OURS, "it may stand beyond either end by this when torque goes on", above=0, most=1
    )

    def check(self) -> None:
        """Raises ValueRangeError where it has nowhere to go."""
        if abs(self.open_angle - self.closed_angle) < 0.01:
            raise ValueRangeError(
                f"open_angle must differ by 0.01 rad or more from closed_angle, got {self.open_angle}"
            )


@dataclass(frozen=True, kw_only=True)
class DynamixelSettings(Settings):
    """Motors, spools and limits. A tendon's entry is at the same place in every list, that of the model's tendons."""

    port: str = setting(meaning="serial device, by a name that stays (/dev/serial/by-id/...)")
    ids: tuple[int, ...] = setting(
        unit="", source=OURS, meaning="on the bus, a motor each tendon", least=0, most=MAX_ID
    )
    spool_radii: Numbers = setting(0.010, "m", OURS, "to the tendon's centre line", above=0, most=0.2)
    signs: Numbers = setting(
        1, "", OURS, "1 where positive rotation lengthens the tendon, -1 where it pulls it in", least=-1, most=1
    )
    lower: Numbers = setting(unit="m", source=PAPER, meaning="of the safe range, which the driver keeps", most=0)
    upper: Numbers = setting(0.0, "m", PAPER, "of the safe range; 0: pulled in only", least=0)
    baud: int = setting(1_000_000, "bit/s", OURS, "as the motors are set", above=0, most=4_500_000)
    mode: str = setting(
        "current_based_position",
        "",
        OURS,
        "current_based_position: the current limits the tension; or extended_position",
        choices=tuple(OPERATING_MODES),
    )
    current_limit: float = setting(1.0, "A", OURS, "about 130 N on a 10 mm spool", above=CURRENT_UNIT, most=MAX_CURRENT)
    # Zero would mean as fast as the motor can; and one unit is the least that is not rounded to zero.
    profile_velocity: float = setting(
        4.0,
        "rad/s",
        OURS,
        "of the motors' own way to a goal",
        above=VELOCITY_UNIT,
        most=MAX_VELOCITY_LIMIT * VELOCITY_UNIT,
    )
    profile_acceleration: float = setting(
        40.0,
        "rad/s^2",
        OURS,
        "of the motors' own way to a goal",
        above=ACCELERATION_UNIT,
        most=MAX_PROFILE_TICKS * ACCELERATION_UNIT,
    )
    position_gains: tuple[int, ...] = setting(
        (800, 0, 0),
        "",
        OURS,
        "P, I and D of the motors' own position control, as their registers have it: the maker's",
        least=0,
        most=MAX_GAIN,
    )
    bus_watchdog: float = setting(
        0.1,
        "s",
        OURS,
        "without a packet, after which a motor stops by itself; rounded up to 20 ms",
        above=0,
        most=MAX_WATCHDOG_TICKS * WATCHDOG_UNIT,
    )
    reply_timeout: float = setting(0.01, "s", OURS, "on top of the time on the line", above=0, most=1)
    torque_constant: float = setting(
        1.3, "N m/A", OURS, "at the output: stall torque over stall current, so tensions are estimates", above=0
    )
    zero_tolerance: float = setting(
        2e-3, "m", OURS, "a tendon may be out of its range by this when torque goes on", above=0, most=0.05
    )
    model_number: int = setting(1030, "", PAPER, "of the motors: XM430-W210", least=0, most=65535)
    minimum_firmware: int = setting(
        38, "", OURS, "the first with the bus watchdog as it is used here", least=0, most=255
    )
    release_torqued: bool = setting(
        False, "", OURS, "connecting lets go of motors that hold torque; false refuses them"
    )
    gripper: GripperSettings | None = setting(
        None, "", OURS, "one more motor, which is held where it is; null: there is none"
    )

    def check(self) -> None:
        """Raises ConfigError or ValueRangeError for a tendon without meaning."""
        ids = [*self.ids, *([self.gripper.id] if self.gripper else [])]
        if not self.ids or any(not isinstance(motor, int) for motor in ids) or len(set(ids)) != len(ids):
            raise ConfigError(f"ids must be whole numbers, and differ from each other and from gripper.id, got {ids}")
        if any(sign not in (-1, 1) for sign in self.each("signs")):
            raise ValueRangeError(f"signs must be -1 or 1, got {self.signs}")
        gains = self.position_gains
        if len(gains) != 3 or any(not isinstance(gain, int) for gain in gains):
            raise ConfigError(f"position_gains must be three whole numbers, P, I and D, got {gains}")
        self.each("spool_radii")
        for lower, upper in zip(self.each("lower"), self.each("upper"), strict=True):
            if not lower < upper:
                raise ValueRangeError(f"lower must be below upper, got {lower} and {upper}")

    def each(self, name: str) -> list[float]:
        """A setting that may be one number for all tendons, as one a tendon."""
        values: list[float] = spread(name, getattr(self, name), len(self.ids)).tolist()
        return values

    @property
    def watchdog_ticks(self) -> int:
        """The bus watchdog in its register's unit."""
        return ceil(self.bus_watchdog / WATCHDOG_UNIT - 1e-9)
