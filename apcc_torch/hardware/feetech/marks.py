"""The mark that a calibration leaves in every servo: it is lost with the count of turns, so it says whether that holds.

An STS servo has no memory to spare that a restart resets. The mark is therefore the speed of its PWM mode, which the
position mode does not use: a restart sets it to 1000, connecting to 0, a calibration to what lies between.
"""

from __future__ import annotations

import secrets
from collections.abc import Sequence

from apcc_torch.hardware.feetech.registers import PWM_SPEED_AT_START

BLANK = 0
DIGITS = 3
BASE = PWM_SPEED_AT_START - 1


def new_mark() -> int:
    """A mark for a whole bus."""
    return secrets.randbelow(BASE**DIGITS)


def parts(mark: int, motors: Sequence[int]) -> dict[int, int]:
    """What each servo bears of a mark, from 1 to 999."""
    return {motor: mark // BASE ** (k % DIGITS) % BASE + 1 for k, motor in enumerate(motors)}
