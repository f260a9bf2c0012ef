"""What a bus of Feetech STS servos needs to be told, in SI units."""

from __future__ import annotations

from dataclasses import dataclass

from apcc_torch.hardware.feetech.models import Model, model_of
from apcc_torch.hardware.feetech.registers import (
    ACCELERATION_UNIT,
    MAX_ACCELERATION,
    MAX_SPEED,
    SPEED_UNITS,
    TORQUE_UNIT,
)
from apcc_torch.hardware.servos.settings import ServoSettings, check_gains
from apcc_torch.settings import OURS, setting
from apcc_torch.spread import Numbers


@dataclass(frozen=True, kw_only=True)
class FeetechSettings(ServoSettings):
    """Motors, spools and limits. A tendon's entry is at the same place in every list, that of the model's tendons."""

    model_number: Numbers = setting(
        777, "", OURS, "of the motors: STS3215; the known ones are in docs/hardware.md", least=0, most=65535
    )
    baud: int = setting(1_000_000, "bit/s", OURS, "as the motors are set", above=0, most=1_000_000)
    torque_limit: Numbers = setting(
        0.4, "", OURS, "of the stall torque: about 120 N on a 10 mm spool with an STS3215 at 12 V", above=TORQUE_UNIT,
        most=1,
    )  # fmt: skip
    # Zero would mean as fast as the motor can; and one unit is the least that is not rounded to zero.
    profile_velocity: float = setting(
        4.0,
        "rad/s",
        OURS,
        "of the motors on their way to a goal",
        above=SPEED_UNITS[0],
        most=MAX_SPEED * SPEED_UNITS[1],
    )
    profile_acceleration: float = setting(
        30.0,
        "rad/s^2",
        OURS,
        "of the motors on their way to a goal",
        above=ACCELERATION_UNIT,
        most=MAX_ACCELERATION * ACCELERATION_UNIT,
    )
    position_gains: tuple[int, ...] | None = setting(
        None,
        "",
        OURS,
        "P, I and D of the motors' own position control, as their registers have it; null: as the motors have it",
        least=0,
        most=254,
    )
    torque_constant: Numbers | None = setting(
        None, "N m/A", OURS, "at the output, so tensions are estimates; null: the 12 V model's", above=0
    )

    def check(self) -> None:
        """Raises ConfigError or ValueRangeError for a tendon without meaning, or a model that is not known."""
        super().check()
        check_gains(self.position_gains)
        self.each("torque_limit")
        for number in self.each("model_number"):
            model_of(number)

    @property
    def models(self) -> dict[int, Model]:
        """The model of each motor by its id. Raises ConfigError where a number is not known."""
        numbers = self.each("model_number")
        return {motor: model_of(number) for motor, number in zip(self.ids, numbers, strict=True)}
