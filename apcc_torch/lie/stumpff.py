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

# Below this x the power series is used, above it the closed form. At x = 4 (two radians) the series' terms are still
# small enough for full precision, and the closed form's subtractions lose less than two digits up to c_6.
_SERIES_BELOW = 4.0
# (-4)^k / (2k + 5)! falls under 1e-17 of c_5(0) at k = 10.
_TERMS = 10
_C5_SERIES = tuple((-1.0) ** k / factorial(2 * k + 5) for k in range(_TERMS))
_C6_SERIES = tuple((-1.0) ** k / factorial(2 * k + 6) for k in range(_TERMS))


class Stumpff(NamedTuple):
    """Stumpff functions of x, each with the shape of x."""

    c0: Tensor
    c1: Tensor
    c2: Tensor
    c3: Tensor
    c4: Tensor
    c5: Tensor
    c6: Tensor


def _horner(coefficients: tuple[float, ...], x: Tensor) -> Tensor:
    value = coefficients[-1] * x + coefficients[-2]
    for coefficient in coefficients[-3::-1]:
        value = value * x + coefficient
    return value


def stumpff(x: Tensor) -> Stumpff:
    """Evaluates c_0 ... c_6 with full precision for every x >= 0, differentiable to any order.

    Args:
        x: (...) squared angle, rad^2, not negative.
    """
    small = x < _SERIES_BELOW
    # The double where: neither branch is ever evaluated where its derivative would be NaN.
    x_small = torch.where(small, x, 0.0)
    x_large = torch.where(small, _SERIES_BELOW, x)

    # Downward recurrence c_m = 1/m! - x c_{m+2}: stable for small x.
    s6 = _horner(_C6_SERIES, x_small)
    s5 = _horner(_C5_SERIES, x_small)
    s4 = 1.0 / 24.0 - x_small * s6
    s3 = 1.0 / 6.0 - x_small * s5
    s2 = 0.5 - x_small * s4
    s1 = 1.0 - x_small * s3
    s0 = 1.0 - x_small * s2

    # Upward recurrence c_{m+2} = (1/m! - c_m) / x: stable for large x.
    angle = torch.sqrt(x_large)
    inverse = 1.0 / x_large
    l0 = torch.cos(angle)
    l1 = torch.sin(angle) / angle
    l2 = (1.0 - l0) * inverse
    l3 = (1.0 - l1) * inverse
    l4 = (0.5 - l2) * inverse
    l5 = (1.0 / 6.0 - l3) * inverse
    l6 = (1.0 / 24.0 - l4) * inverse

    series = torch.stack((s0, s1, s2, s3, s4, s5, s6), dim=-1)
    closed = torch.stack((l0, l1, l2, l3, l4, l5, l6), dim=-1)
    return Stumpff(*torch.where(small.unsqueeze(-1), series, closed).unbind(-1))
