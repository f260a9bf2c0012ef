"""The mark that a calibration leaves in every motor: it is lost with the count of turns, so it says whether that holds.

A motor counts its turns only while it has power. Stored zeros are worth nothing after a restart, and the position
alone cannot tell. The mark lies in indirect addresses that the driver has no other use for; they are memory that a
restart resets. Each of its digits is a legal address.
"""

from __future__ import annotations

from apcc_torch.hardware.dynamixel.models import Model
from apcc_torch.hardware.dynamixel.registers import INDIRECT_ADDRESS

DIGITS = 4  # each in a slot of its own, the last that the model has
BASE = 64
MARKS = BASE**DIGITS
LOWEST_ADDRESS = 64  # the lowest that an indirect address may hold


def address(model: Model) -> int:
    """Where a motor bears it."""
    return INDIRECT_ADDRESS + 2 * (model.slots - DIGITS)


def encoded(model: Model, mark: int | None) -> bytes:
    """The mark as it is written, 2 `DIGITS` bytes; None: no mark."""
    if mark is None:
        return (model.indirect_data + model.slots - DIGITS).to_bytes(2, "little") * DIGITS
    digits = (mark // BASE**k % BASE for k in range(DIGITS))
    return b"".join((LOWEST_ADDRESS + digit).to_bytes(2, "little") for digit in digits)
