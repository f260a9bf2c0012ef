"""The gripper: one more motor on the tendons' bus, with a surface of its own."""

from __future__ import annotations

from math import isfinite

from apcc_torch.errors import HardwareError, SafetyError, ValueRangeError
from apcc_torch.hardware.dynamixel.motors import Motors
from apcc_torch.hardware.dynamixel.settings import GripperSettings
from apcc_torch.hardware.servos.spool import TICK


class Gripper:
    """Opens and closes; armed, read and let go together with the tendons."""

    def __init__(self, motors: Motors, settings: GripperSettings) -> None:
        self.motors = motors
        self.settings = settings
        self.closed = round(settings.closed_angle / TICK)
        self.opened = round(settings.open_angle / TICK)

    def open(self) -> None:
        """Opens fully."""
        self.goal(1.0)

    def close(self) -> None:
        """Closes fully, with the current limit as the grip."""
        self.goal(0.0)

    def goal(self, opening: float) -> float:
        """Goes to an opening from 0, closed, to 1; returns what was sent, after the ends and ticks.

        Raises:
            HardwareError: Not armed, or the packet could not be sent.
            ValueRangeError: `opening` is not finite.
        """
        if not isfinite(opening):
            raise ValueRangeError(f"opening must be finite, got {opening}")
        if not self.motors.armed:
            raise HardwareError("the gripper is not armed")
        span = self.opened - self.closed
        ticks = self.closed + round(min(max(opening, 0.0), 1.0) * span)
        self.motors.write_goals({self.settings.id: ticks})
        return (ticks - self.closed) / span

    def opening(self) -> float:
        """Where it is: 0 closed, 1 open. Raises a HardwareError if a motor does not answer."""
        position = self.motors.status()[self.settings.id].position
        return (position - self.closed) / (self.opened - self.closed)

    def arming_goal(self, position: int) -> int:
        """The goal, in ticks, that keeps it where it is.

        Raises:
            SafetyError: It stands beyond its ends.
        """
        low, high = sorted((self.closed, self.opened))
        goal = min(max(position, low), high)
        if abs(position - goal) * TICK > self.settings.tolerance:
            angle, ends = position * TICK, f"{low * TICK:.3f} to {high * TICK:.3f} rad"
            raise SafetyError(f"the gripper (id {self.settings.id}) is at {angle:.3f} rad, outside {ends}")
        return goal
