"""The mark that a calibration leaves in every motor: it is lost with the count of turns, so it says whether that holds.

A motor counts its turns only while it has power. Stored zeros are worth nothing after a restart, and the position
alone cannot tell. The mark lies in indirect addresses that the driver has no other use for; they are memory that a
restart resets. Each of its digits is a legal address.
"""

from __future__ import annotations

import secrets
from collections.abc import Mapping

from apcc_torch.errors import HardwareError
from apcc_torch.hardware.dynamixel.bus import DynamixelBus
from apcc_torch.hardware.dynamixel.models import Model
from apcc_torch.hardware.dynamixel.registers import INDIRECT_ADDRESS

DIGITS = 4  # each in a slot of its own, the last that the model has
BASE = 64
LOWEST_ADDRESS = 64  # the lowest that an indirect address may hold


def _address(model: Model) -> int:
    return INDIRECT_ADDRESS + 2 * (model.slots - DIGITS)


def _encode(mark: int) -> bytes:
    digits = (mark // BASE**k % BASE for k in range(DIGITS))
    return b"".join((LOWEST_ADDRESS + digit).to_bytes(2, "little") for digit in digits)


def leave_mark(bus: DynamixelBus, motors: Mapping[int, Model]) -> int:
    """Writes a new mark to all motors; returns it."""
    mark = secrets.randbelow(BASE**DIGITS)
    for motor, model in motors.items():
        bus.write_bytes(motor, _address(model), _encode(mark))
    return mark


def erase_mark(bus: DynamixelBus, motor: int, model: Model) -> None:
    """Takes the mark off a motor whose count of turns is lost by what is done to it."""
    blank = (model.indirect_data + model.slots - DIGITS).to_bytes(2, "little") * DIGITS
    bus.write_bytes(motor, _address(model), blank)


def check_mark(bus: DynamixelBus, motors: Mapping[int, Model], mark: int) -> None:
    """Raises HardwareError, which names each motor that does not bear the mark."""
    held = {motor: bus.read_bytes(motor, _address(model), 2 * DIGITS) for motor, model in motors.items()}
    lost = [motor for motor, data in held.items() if data != _encode(mark)]
    if lost:
        names = ", ".join(bus.name(motor) for motor in lost)
        raise HardwareError(f"{names} lost power since that calibration, or has a newer one: calibrate again")
