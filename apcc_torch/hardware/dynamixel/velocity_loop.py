"""The way to a goal where the motors are told velocities: the position loop on this side of the bus."""

from __future__ import annotations

from collections.abc import Iterable, Mapping

from apcc_torch.hardware.dynamixel.registers import VELOCITY_UNIT
from apcc_torch.hardware.servos.spool import TICK

TICKS_PER_UNIT = VELOCITY_UNIT / TICK  # ticks/s


class VelocityLoop:
    """Velocities that bring motors to their goals, and never past them.

    The velocity is gain x distance to the goal, at most `fastest`, and rounded towards zero. It may outlive the program
    that sent it: a motor goes on until its watchdog stops it. With gain x watchdog <= 1 it is then no further than at
    its goal, which is within the tendon's limits. With gain x fastest <= acceleration it can brake as fast as the
    velocity falls.

    No reading, no motion: a velocity is sent on a reading that no velocity was sent on before; without one it is zero.

    Args:
        motors: Their ids.
        gain: 1/s.
        fastest: rad/s.

    Example:
        >>> loop = VelocityLoop([7], gain=8.0, fastest=4.0)
        >>> loop.goals[7] = 1000
        >>> loop.see({7: 900}), loop.take(), loop.take()
        (None, {7: 51}, {7: 0})
    """

    def __init__(self, motors: Iterable[int], gain: float, fastest: float) -> None:
        self.motors = tuple(motors)
        self.gain = gain
        self.most = int(fastest / VELOCITY_UNIT)
        self.goals: dict[int, int] = {}  # ticks
        self.holding = False  # whether every reading is answered with velocities, not only a new goal
        self._seen: dict[int, int] = {}

    def reset(self) -> None:
        """Forgets everything: torque is off."""
        self.goals.clear()
        self._seen.clear()
        self.holding = False

    def see(self, positions: Mapping[int, int]) -> None:
        """Positions, ticks, of the motors that could be read just now."""
        self._seen = {motor: positions[motor] for motor in self.motors if motor in positions}

    def take(self) -> dict[int, int]:
        """The velocity of every motor, in the register's unit."""
        seen, self._seen = self._seen, {}
        return {motor: self._velocity(motor, seen) for motor in self.motors}

    def _velocity(self, motor: int, seen: Mapping[int, int]) -> int:
        if motor not in seen or motor not in self.goals:
            return 0
        wanted = self.gain * (self.goals[motor] - seen[motor]) / TICKS_PER_UNIT
        return int(min(max(wanted, -self.most), self.most))
