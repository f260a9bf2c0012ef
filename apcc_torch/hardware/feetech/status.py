"""The status block of an STS servo: all that a restart loses and all that it measures lie in one row of its table."""

from __future__ import annotations

from typing import NamedTuple

from apcc_torch.errors import CommunicationError
from apcc_torch.hardware.feetech import registers

STATUS_BLOCK = (
    registers.TORQUE_SWITCH,
    registers.ACCELERATION,
    registers.GOAL_POSITION,
    registers.PWM_SPEED,
    registers.RUNNING_SPEED,
    registers.TORQUE_LIMIT,
    registers.PRESENT_POSITION,
    registers.PRESENT_SPEED,
    registers.PRESENT_LOAD,
    registers.STATUS,
    registers.PRESENT_CURRENT,
)
STATUS_ADDRESS = registers.TORQUE_SWITCH.address
STATUS_LENGTH = registers.PRESENT_CURRENT.address + registers.PRESENT_CURRENT.length - STATUS_ADDRESS


class StsStatus(NamedTuple):
    """One servo's status, in the registers' units, in the block's order.

    mark: Of the calibration, see `marks`.
    """

    torque: int
    acceleration: int
    goal: int
    mark: int
    running_speed: int
    torque_limit: int
    position: int
    speed: int
    load: int
    errors: int
    current: int

    @classmethod
    def decode(cls, data: bytes) -> StsStatus:
        """The status of one servo. Raises CommunicationError if the block has another length."""
        if len(data) != STATUS_LENGTH:
            raise CommunicationError(f"a status has {STATUS_LENGTH} bytes, got {len(data)}")
        starts = ((register, register.address - STATUS_ADDRESS) for register in STATUS_BLOCK)
        return cls(*(register.decode(data[start : start + register.length]) for register, start in starts))

    @property
    def restarted(self) -> bool:
        """Whether the servo has lost what connecting wrote, and with it its count of turns."""
        return self.mark == registers.PWM_SPEED_AT_START

    def fault(self, armed: bool, torque_limit: int) -> str:
        """What is wrong, in words, "" if nothing is.

        Args:
            armed: Whether torque should be on.
            torque_limit: What its register should hold while armed.
        """
        if self.restarted:
            return "has restarted and lost its zero: connect and calibrate again"
        if self.errors:
            torque = "" if self.torque or not armed else ", and has let go"
            return f"reports {registers.status_names(self.errors)}{torque}"
        if armed and not self.torque:
            return "has lost its torque"
        if armed and self.torque_limit != torque_limit:
            return f"has torque limit {self.torque_limit} instead of {torque_limit}"
        return ""
