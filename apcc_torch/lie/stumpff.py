"""Stumpff functions: the smooth scalar functions of x = angle^2 that every rotation and every arc is made of.

c_m(x) = sum_k (-x)^k / (2k + m)!, so c_0 = cos D, c_1 = sin(D)/D, c_2 = (1 - cos D)/D^2, c_3 = (D - sin D)/D^3 with
x = D^2. They are entire functions of x: nothing is singular at the straight pose, and every derivative is again a
combination of Stumpff functions, c_m' = (m c_{m+2} - c_{m+1}) / 2.
"""

from __future__ import annotations

from math import factorial
from typing import NamedTuple

import torch
from torch import Tensor

from apcc_torch.modes import known

# Below this x the power series is used, above it the closed form. At x = 4 (two radians) the series' terms are still
# small enough for full precision, and the closed form's subtractions lose less than two digits up to c_6.
_SERIES_BELOW = 4.0
# (-4)^k / (2k + 5)! falls under 1e-17 of c_5(0) at k = 10.
_TERMS = 10


class Stumpff(NamedTuple):
    """Stumpff functions of x, each with the shape of x."""

    c0: Tensor
    c1: Tensor
    c2: Tensor
    c3: Tensor
    c4: Tensor
    c5: Tensor
    c6: Tensor


def _series(m: int, x: Tensor, one: Tensor) -> Tensor:
    """m! c_m(x) = 1 - x / ((m+1)(m+2)) (1 - x / ((m+3)(m+4)) (1 - ...)), one operation a term."""
    value = one
    for k in range(m + 2 * _TERMS - 1, m, -2):
        value = torch.addcmul(one, x, value, value=-1.0 / (k * (k + 1)))
    return value


def stumpff(x: Tensor) -> Stumpff:
    """Evaluates c_0 ... c_6 with full precision for every x >= 0, differentiable to any order.

    Args:
        x: (...) squared angle, rad^2, not negative.
    """
    small = x < _SERIES_BELOW
    all_small = known(small)
    # Clamped before and selected after: neither branch is ever evaluated where its derivative would be NaN.
    low = x if all_small else x.clamp(max=_SERIES_BELOW)
    one = torch.ones_like(x)
    half, sixth, twentyfourth = (torch.full_like(x, 1.0 / factorial(m)) for m in (2, 3, 4))

    # Downward recurrence c_m = 1/m! - x c_{m+2}: stable for small x.
    p6, p5 = _series(6, low, one), _series(5, low, one)
    s4 = torch.addcmul(twentyfourth, low, p6, value=-1.0 / factorial(6))
    s3 = torch.addcmul(sixth, low, p5, value=-1.0 / factorial(5))
    s2 = torch.addcmul(half, low, s4, value=-1.0)
    s1 = torch.addcmul(one, low, s3, value=-1.0)
    s0 = torch.addcmul(one, low, s2, value=-1.0)
    series = Stumpff(s0, s1, s2, s3, s4, p5 / factorial(5), p6 / factorial(6))
    if all_small:
        return series

    # Upward recurrence c_{m+2} = (1/m! - c_m) / x: stable for large x.
    high = x.clamp(min=_SERIES_BELOW)
    angle, inverse = torch.sqrt(high), high.reciprocal()
    l0 = torch.cos(angle)
    l1 = torch.sin(angle) / angle
    l2 = (one - l0) * inverse
    l3 = (one - l1) * inverse
    l4 = (half - l2) * inverse
    l5 = (sixth - l3) * inverse
    l6 = (twentyfourth - l4) * inverse

    closed = (l0, l1, l2, l3, l4, l5, l6)
    return Stumpff(*(torch.where(small, s, c) for s, c in zip(series, closed, strict=True)))


def stumpff_c7(x: Tensor, c5: Tensor) -> Tensor:
    """c_7 of the same x, given c_5: what only second derivatives of lengths along a twist need."""
    small = x < _SERIES_BELOW
    low = _series(7, x.clamp(max=_SERIES_BELOW), torch.ones_like(x)) / factorial(7)
    return torch.where(small, low, (1.0 / factorial(5) - c5) / x.clamp(min=_SERIES_BELOW))
