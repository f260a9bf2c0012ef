"""What the emulated models differ in, from the maker's pages of each; not taken from the package's file."""

from __future__ import annotations

from typing import NamedTuple

XM430_W210, XM430_W350, XL430_W250, XL330_M288 = 1030, 1020, 1060, 1200


class Table(NamedTuple):
    """Largest current limit in units (0: there is none), largest velocity limit, P and D gain as delivered, indirect
    slots, shutdown as delivered, supply in 0.1 V, rev/min without load.
    """

    current: int
    velocity: int
    p_gain: int
    d_gain: int
    slots: int
    shutdown: int
    supply: int
    speed: float


TABLES = {
    XM430_W210: Table(1193, 1023, 800, 0, 28, 0b110100, 120, 95),
    XM430_W350: Table(1193, 1023, 800, 0, 28, 0b110100, 120, 57),
    XL430_W250: Table(0, 1023, 640, 4000, 28, 0b110100, 120, 61),
    XL330_M288: Table(1750, 2047, 400, 0, 20, 0b110101, 50, 123),
}
