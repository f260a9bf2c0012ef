"""The status block: what one sync read returns of every motor, and the faults that show in it.

The bytes lie all over the control table. Indirect addresses gather them in one place, at every connection anew: a motor
that restarts loses them and then returns zeros. The status return level, which is never zero here, tells.
"""

from __future__ import annotations

from typing import NamedTuple

from apcc_torch.hardware.dynamixel import registers

STATUS_BLOCK = (
    registers.PRESENT_CURRENT,
    registers.PRESENT_VELOCITY,
    registers.PRESENT_POSITION,
    registers.TORQUE_ENABLE,
    registers.HARDWARE_ERROR,
    registers.BUS_WATCHDOG,
    registers.STATUS_RETURN_LEVEL,
)
STATUS_LENGTH = sum(register.length for register in STATUS_BLOCK)
ANSWERS_EVERYTHING = 2  # the status return level that the driver needs, and a motor's own at its start


def indirect_addresses() -> bytes:
    """The indirect address table that gathers the block, as it is written."""
    addresses = (register.address + k for register in STATUS_BLOCK for k in range(register.length))
    return b"".join(address.to_bytes(2, "little") for address in addresses)


class MotorStatus(NamedTuple):
    """One motor's status block, in the registers' units, in the block's order."""

    current: int
    velocity: int
    position: int
    torque: int
    hardware_error: int
    watchdog: int
    return_level: int

    @classmethod
    def decode(cls, data: bytes) -> MotorStatus:
        """The block of one motor. Raises CommunicationError if it has another length."""
        values, start = [], 0
        for register in STATUS_BLOCK:
            values.append(register.decode(data[start : start + register.length]))
            start += register.length
        return cls(*values)

    @property
    def restarted(self) -> bool:
        """Whether the motor has lost what connecting wrote, and with it its count of turns."""
        return self.return_level != ANSWERS_EVERYTHING

    def fault(self, armed: bool, watchdog: int) -> str:
        """What is wrong, in words, "" if nothing is.

        Args:
            armed: Whether torque should be on.
            watchdog: What its bus watchdog should hold while armed.
        """
        if self.restarted:
            return "has restarted and lost its zero: connect and calibrate again"
        if self.hardware_error:
            torque = "" if self.torque or not armed else ", and has let go"
            return f"reports {registers.hardware_errors(self.hardware_error)}{torque}"
        if armed and self.watchdog == registers.WATCHDOG_TRIPPED:
            return "has stopped: its bus watchdog tripped, and it refuses goals until it is armed again"
        if armed and not self.torque:
            return "has lost its torque"
        if armed and self.watchdog != watchdog:
            return f"has bus watchdog {self.watchdog} instead of {watchdog}"
        return ""
