"""Ticks and lengths: there and back, signs, limits."""

from __future__ import annotations

from fractions import Fraction
from math import pi

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from apcc_torch.errors import ShapeError, ValueRangeError
from apcc_torch.hardware.servos.spool import Spools

MAX_POSITION = 1_048_575
RADII = st.floats(0.002, 0.1)
ENDS = st.tuples(st.floats(-0.2, -1e-3), st.floats(0, 0.05))
ZERO = st.integers(-900_000, 900_000)
SIGN = st.sampled_from([-1, 1])


def one(radius: float, sign: int, zero: int, lower: float = -0.075, upper: float = 0.0) -> Spools:
    return Spools(
        np.array([radius]), np.array([sign]), np.array([lower]), np.array([upper]), np.array([zero]), MAX_POSITION
    )


@given(radius=RADII, sign=SIGN, zero=ZERO, ends=ENDS, part=st.floats(0, 1))
def test_ticks_to_length_and_back(radius: float, sign: int, zero: int, ends: tuple[float, float], part: float) -> None:
    spools = one(radius, sign, zero, *ends)
    low, high = (int(bound[0]) for bound in spools.bounds)
    ticks = np.array([low + round(part * (high - low))])
    assert spools.ticks(spools.length(ticks)) == ticks


@given(radius=RADII, sign=SIGN, zero=ZERO, ends=ENDS, y=st.floats(-1, 1))
def test_a_length_is_met_to_half_a_tick_or_by_the_nearer_end(
    radius: float, sign: int, zero: int, ends: tuple[float, float], y: float
) -> None:
    spools = one(radius, sign, zero, *ends)
    tick = 2 * pi * radius / 4096
    got = spools.length(spools.ticks(np.array([y])))[0]
    assert ends[0] - 1e-12 <= got <= ends[1] + 1e-12
    wanted = min(max(y, ends[0]), ends[1])
    inside = ends[0] + tick <= y <= ends[1] - tick
    assert abs(got - wanted) <= (0.5 if inside else 1.0) * tick * (1 + 1e-6) + 1e-12


@given(
    radius=RADII, sign=SIGN, zero=ZERO, y=st.floats(-0.1, 0.05), last=st.integers(-200, -10), reach=st.floats(0, 0.003)
)
def test_between_two_lengths_no_rounding_leaves_them(
    radius: float, sign: int, zero: int, y: float, last: int, reach: float
) -> None:
    """What a command may change is a limit of the ticks that are sent, and not only of the lengths that are wanted."""
    spools, tick = one(radius, sign, zero), 2 * pi * radius / 4096
    low, high = max(last * tick - reach, -0.075), min(last * tick + reach, 0.0)
    if low > high:
        return
    least, greatest = spools.between(np.array([low]), np.array([high]))
    got = spools.length(np.clip(spools.ticks(np.array([y])), least, greatest))[0]
    assert low - 1e-12 <= got <= high + 1e-12
    assert abs(got - min(max(y, low), high)) <= tick * (1 + 1e-6)


def test_the_bounds_are_whole_ticks_within_the_limits() -> None:
    # 4096 ticks on a spool of 0.5 / pi mm are 1 mm: 75 mm are 75 * 4096 ticks, exactly.
    for sign in (-1, 1):
        low, high = one(0.5e-3 / pi, sign, 7).bounds
        whole = int(Fraction(75) * 4096)
        assert (low[0], high[0]) == ((7 - whole, 7) if sign == 1 else (7, 7 + whole))


@given(y=st.one_of(st.floats(-1e308, 1e308), st.sampled_from([1e300, -1e300])), sign=SIGN)
def test_huge_lengths_are_clipped_and_not_wrapped(y: float, sign: int) -> None:
    spools = one(0.01, sign, 0)
    assert spools.bounds[0] <= spools.ticks(np.array([y])) <= spools.bounds[1]


def test_rates_and_tensions() -> None:
    spools = one(0.01, -1, 0)
    # 22.9 rev/min shorten the tendon at a radius of 10 mm.
    assert spools.rate(np.array([22.9 / 60 * 2 * pi]))[0] == pytest.approx(-22.9 / 60 * 2 * pi * 0.01)
    # 1.3 N m pull in with 130 N.
    assert spools.tension(np.array([1.3]))[0] == pytest.approx(130)
    assert one(0.01, 1, 0).tension(np.array([1.3]))[0] == pytest.approx(-130)


def test_refusals() -> None:
    with pytest.raises(ValueRangeError, match=r"tendon 1 would leave the motor's range"):
        one(0.01, 1, -MAX_POSITION)
    with pytest.raises(ShapeError, match=r"y must have shape \(1,\), got \(2,\)"):
        one(0.01, 1, 0).ticks(np.zeros(2))
    with pytest.raises(ValueRangeError, match="y must be finite"):
        one(0.01, 1, 0).ticks(np.array([np.nan]))
