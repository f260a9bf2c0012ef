"""The models of the X series: what models.yaml says of each, by its number."""

from __future__ import annotations

from functools import cache
from pathlib import Path
from typing import Any, NamedTuple

import yaml

from apcc_torch.hardware.dynamixel.registers import INDIRECT_ADDRESS, MAX_PWM
from apcc_torch.hardware.servos.known_model import known_model
from apcc_torch.hardware.servos.spool import TICKS_PER_TURN

FILE = Path(__file__).with_name("models.yaml")
MARGIN = 1.16  # of the no-load speed: supplies above their nominal voltage, and readings that are not evenly spaced


class Model(NamedTuple):
    """One model, in SI units where the name has no register's.

    number: What the motor says it is. current_unit: A, None without current sensing. current_limit: Largest, in that
    unit. velocity_limit: Largest, in the register's unit. gains: P, I and D of the position control, as delivered.
    slots: Of indirect addresses. shutdown: Which faults let go, as delivered. stall_torque: N m, stall_current: A, both
    at `voltage`, V. speed: rev/min without load at the highest voltage. firmware: The least.
    """

    number: int
    name: str
    current_unit: float | None
    current_limit: int
    velocity_limit: int
    gains: tuple[int, int, int]
    slots: int
    shutdown: int
    stall_torque: float
    stall_current: float
    voltage: float
    speed: float
    firmware: int

    @property
    def indirect_data(self) -> int:
        """The address at which the bytes of the indirect addresses' slots begin."""
        return INDIRECT_ADDRESS + 2 * self.slots

    @property
    def largest_current(self) -> float:
        """A; of a motor without current sensing what it draws at a stall."""
        return self.stall_current if self.current_unit is None else self.current_limit * self.current_unit

    @property
    def torque_constant(self) -> float:
        """N m/A at the output: stall torque over stall current, so torques are estimates."""
        return self.stall_torque / self.stall_current

    @property
    def fastest(self) -> float:
        """Ticks/s that it does not reach."""
        return MARGIN * self.speed / 60 * TICKS_PER_TURN

    def current_ticks(self, current: float) -> int:
        """A current, A, in the register's unit, rounded down."""
        assert self.current_unit is not None
        return int(current / self.current_unit)

    def stalled_pwm(self, current: float, voltage: float) -> int:
        """The largest PWM at which a stalled motor draws no more than `current`, A, of a supply of `voltage`, V.

        At a stall a motor is a resistance: its current is the share of the supply that reaches it, over that.
        """
        at_full = self.stall_current * voltage / self.voltage
        return min(MAX_PWM, int(MAX_PWM * current / at_full))


@cache
def models() -> dict[int, Model]:
    """All known models by their number."""
    rows: dict[int, dict[str, Any]] = yaml.safe_load(FILE.read_text(encoding="utf-8"))
    return {number: _model(number, **row | {"gains": tuple(row["gains"])}) for number, row in rows.items()}


def _model(
    number: int,
    *,
    name: str,
    current: tuple[float, int] | None,
    velocity: int,
    gains: tuple[int, int, int],
    slots: int,
    shutdown: int,
    stall: tuple[float, float, float],
    speed: float,
    firmware: int,
) -> Model:
    unit, largest = current or (None, 0)
    return Model(number, name, unit, largest, velocity, gains, slots, shutdown, *stall, speed, firmware)


def model_of(number: float) -> Model:
    """The model of a number.

    Raises:
        ConfigError: It is not known.
    """
    return known_model(models(), number)
