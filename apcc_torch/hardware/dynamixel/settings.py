"""What a bus of Dynamixel motors needs to be told, in SI units."""

from __future__ import annotations

from dataclasses import dataclass
from math import ceil, pi

from apcc_torch.errors import ValueRangeError
from apcc_torch.hardware.dynamixel.models import Model, model_of
from apcc_torch.hardware.dynamixel.registers import (
    ACCELERATION_UNIT,
    MAX_GAIN,
    MAX_PROFILE_TICKS,
    OPERATING_MODES,
    VELOCITY_UNIT,
    WATCHDOG_UNIT,
)
from apcc_torch.hardware.servos.settings import MAX_ID, ServoSettings, check_gains
from apcc_torch.settings import OURS, PAPER, Settings, setting
from apcc_torch.spread import Numbers

MAX_WATCHDOG_TICKS = 127
VELOCITY, EXTENDED, CURRENT_BASED = OPERATING_MODES
ROUND_OFF = 1e-9


@dataclass(frozen=True, kw_only=True)
class GripperSettings(Settings):
    """A gripper's motor on the same bus. It turns less than once, so its encoder's own zero is enough."""

    id: int = setting(meaning="on the bus", least=0, most=MAX_ID)
    model_number: int = setting(
        1030, "", PAPER, "of the motor: XM430-W210; the known ones are in docs/hardware.md", least=0, most=65535
    )
    open_angle: float = setting(1.0, "rad", OURS, "of its encoder", least=0, below=2 * pi)
    closed_angle: float = setting(2.0, "rad", OURS, "of its encoder", least=0, below=2 * pi)
    current_limit: float = setting(0.3, "A", OURS, "the grip", above=0)
    tolerance: float = setting(
        0.1, "rad", OURS, "it may stand beyond either end by this when torque goes on", above=0, most=1
    )

    def check(self) -> None:
        """Raises ConfigError or ValueRangeError where it has nowhere to go, or a limit that its model has not."""
        if abs(self.open_angle - self.closed_angle) < 0.01:
            raise ValueRangeError(
                f"open_angle must differ by 0.01 rad or more from closed_angle, got {self.open_angle}"
            )
        _check_current(model_of(self.model_number), self.current_limit)


@dataclass(frozen=True, kw_only=True)
class DynamixelSettings(ServoSettings):
    """Motors, spools and limits. A tendon's entry is at the same place in every list, that of the model's tendons."""

    model_number: Numbers = setting(
        1030, "", PAPER, "of the motors: XM430-W210; the known ones are in docs/hardware.md", least=0, most=65535
    )
    baud: int = setting(1_000_000, "bit/s", OURS, "as the motors are set", above=0, most=4_500_000)
    # Two ways to limit the tension: the motor's own control of its current, and the voltage at which it stalls there.
    mode: str = setting(
        CURRENT_BASED,
        "",
        OURS,
        "current_based_position: the motors' own way to a goal, the tension limited; extended_position: not limited; "
        "velocity: this driver's way, see docs/hardware.md",
        choices=tuple(OPERATING_MODES),
    )
    current_limit: Numbers = setting(1.0, "A", OURS, "about 130 N on a 10 mm spool with an XM430-W210", above=0)
    # Zero would mean as fast as the motor can; and one unit is the least that is not rounded to zero.
    profile_velocity: float = setting(4.0, "rad/s", OURS, "of the motors on their way to a goal", above=VELOCITY_UNIT)
    profile_acceleration: float = setting(
        40.0,
        "rad/s^2",
        OURS,
        "of the motors on their way to a goal",
        above=ACCELERATION_UNIT,
        most=MAX_PROFILE_TICKS * ACCELERATION_UNIT,
    )
    position_gains: tuple[int, ...] | None = setting(
        None,
        "",
        OURS,
        "P, I and D of the motors' own position control, as their registers have it; null: as the model is delivered",
        least=0,
        most=MAX_GAIN,
    )
    velocity_gain: float = setting(
        8.0, "1/s", OURS, "mode velocity: of the way to a goal; at most 1 / bus_watchdog", above=0
    )
    bus_watchdog: float = setting(
        0.1,
        "s",
        OURS,
        "without a packet, after which a motor stops by itself; rounded up to 20 ms",
        above=0,
        most=MAX_WATCHDOG_TICKS * WATCHDOG_UNIT,
    )
    torque_constant: Numbers | None = setting(
        None,
        "N m/A",
        OURS,
        "at the output, so tensions are estimates; null: the model's stall torque over its stall current",
        above=0,
    )
    minimum_firmware: int | None = setting(
        None, "", OURS, "null: the model's first with what the driver uses", least=0, most=255
    )
    gripper: GripperSettings | None = setting(
        None, "", OURS, "one more motor, which is held where it is; null: there is none"
    )

    @property
    def every_id(self) -> tuple[int, ...]:
        """The tendons' motors, the gripper's last."""
        return (*self.ids, *((self.gripper.id,) if self.gripper else ()))

    def _beside(self) -> str:
        return " and from gripper.id"

    def check(self) -> None:
        """Raises ConfigError or ValueRangeError for a tendon without meaning, or a limit that its model has not."""
        super().check()
        check_gains(self.position_gains)
        for model, current in zip(self.tendon_models, self.each("current_limit"), strict=True):
            _check_current(model, current)
        for model in self.models.values():
            fastest = model.velocity_limit * VELOCITY_UNIT
            if self.profile_velocity > fastest:
                raise ValueRangeError(
                    f"profile_velocity must be at most {fastest:.4g} rad/s for {model.name}, "
                    f"got {self.profile_velocity}"
                )
        if self.mode == VELOCITY:
            self._check_velocity()

    def _check_velocity(self) -> None:
        """What makes sure that no motor passes its goal, whenever the program ends, see `VelocityLoop`."""
        watchdog = self.watchdog_ticks * WATCHDOG_UNIT
        if self.velocity_gain * watchdog > 1 + ROUND_OFF:
            raise ValueRangeError(
                f"velocity_gain must be at most {1 / watchdog:.4g} 1/s with a bus_watchdog of {watchdog:g} s, "
                f"got {self.velocity_gain}"
            )
        if self.velocity_gain * self.profile_velocity > self.profile_acceleration * (1 + ROUND_OFF):
            raise ValueRangeError(
                f"velocity_gain must be at most profile_acceleration / profile_velocity, "
                f"{self.profile_acceleration / self.profile_velocity:.4g} 1/s, got {self.velocity_gain}"
            )

    @property
    def tendon_models(self) -> tuple[Model, ...]:
        """The model of each tendon's motor. Raises ConfigError where a number is not known."""
        return tuple(model_of(number) for number in self.each("model_number"))

    @property
    def models(self) -> dict[int, Model]:
        """The model of each motor by its id."""
        found = dict(zip(self.ids, self.tendon_models, strict=True))
        return found | ({self.gripper.id: model_of(self.gripper.model_number)} if self.gripper else {})

    @property
    def currents(self) -> dict[int, float]:
        """The current limit of each motor by its id, A."""
        found = dict(zip(self.ids, self.each("current_limit"), strict=True))
        return found | ({self.gripper.id: self.gripper.current_limit} if self.gripper else {})

    def mode_of(self, motor: int) -> str:
        """The operating mode of one motor: the settings', as far as its model has it; a gripper keeps its position."""
        of_tendon = motor in self.ids
        if self.mode == EXTENDED or (self.mode == VELOCITY and of_tendon):
            return self.mode
        return EXTENDED if self.models[motor].current_unit is None else CURRENT_BASED

    def limited_by_voltage(self, motor: int) -> bool:
        """Whether the voltage has to limit a motor's current: no controller of the motor's does."""
        return self.mode != EXTENDED and self.mode_of(motor) != CURRENT_BASED

    @property
    def watchdog_ticks(self) -> int:
        """The bus watchdog in its register's unit."""
        return ceil(self.bus_watchdog / WATCHDOG_UNIT - ROUND_OFF)


def _check_current(model: Model, current: float) -> None:
    if current > model.largest_current * (1 + ROUND_OFF):
        raise ValueRangeError(
            f"current_limit must be at most {model.largest_current:.4g} A for {model.name}, got {current}"
        )
    if model.current_unit is not None and current < model.current_unit:
        raise ValueRangeError(f"current_limit must be {model.current_unit} A or more for {model.name}, got {current}")
