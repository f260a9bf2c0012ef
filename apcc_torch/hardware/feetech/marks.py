"""The mark that a calibration leaves in every servo: it is lost with the count of turns, so it says whether that holds.

An STS servo has no memory to spare that a restart resets. The mark is therefore the speed of its PWM mode, which the
position mode does not use: a restart sets it to 1000, connecting to 0, a calibration to what lies between.
"""

from __future__ import annotations

from apcc_torch.hardware.feetech.registers import PWM_SPEED_AT_START

BLANK = 0
DIGITS = 3
BASE = PWM_SPEED_AT_START - 1
MARKS = BASE**DIGITS


def part(mark: int, k: int) -> int:
    """What servo k of a bus bears of a mark, from 1 to 999."""
    return mark // BASE ** (k % DIGITS) % BASE + 1
