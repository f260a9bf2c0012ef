"""What a fit is worth where it has not looked: every movement left out in turn, by one step of Newton's method each.

A model's errors are not the independent noise that least squares take them for. They repeat through a movement, so
whole movements are left out: how far the parameters then move says how well they are known (the jackknife), and how
far the movement is off says how far predictions are.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from torch import Tensor

FEWEST = 8
"""Movements that a recording must name to be cut by them; with fewer it is cut into stretches..."""
STRETCHES = 10
"""...of equal length, so many of them."""
NORMAL_95 = 1.959963984540054
"""Standard deviations either side of the mean that hold 95 % of a normal distribution."""
_COVERED = 0.95


class LeftOut(NamedTuple):
    """What N samples of M movements say of each other.

    steps: (M, P) by which the scores move when a movement is left out.
    error: (N, 3 k) of every sample, m, by the fit that has not seen its movement.
    """

    steps: Tensor
    error: Tensor

    def covariance(self, posterior: Tensor) -> Tensor:
        """Of the scores (P, P): the jackknife's, and what the belief before the fit leaves open.

        Args:
            posterior: (P, P) inverse of the information and the belief's identity.
        """
        M = len(self.steps)
        return (M - 1) / M * self.steps.mT @ self.steps + posterior @ posterior


class Margins(NamedTuple):
    """Of each of k bodies, how far a prediction may be off: its variance is wander J V J^T + floor^2.

    J is the body's derivative by the scores and V their covariance if all errors were independent.

    wander: (k,) how much more than that parameters seem to move from movement to movement.
    floor: (k,) m, what no parameters explain.
    reach: (k,) deviations that 95 % of the errors of left-out movements lie within.
    """

    wander: Tensor
    floor: Tensor
    reach: Tensor

    def half_width(self, J: Tensor, posterior: Tensor) -> Tensor:
        """Half of the 95 % interval of every coordinate (N, k, 3), m.

        Args:
            J: (N, k, 3, P) derivatives of the bodies' positions by the scores, m.
            posterior: (P, P) as in `LeftOut.covariance`.
        """
        variance = self.wander.unsqueeze(-1) * leverage(J, posterior) + self.floor.square().unsqueeze(-1)
        return self.reach.unsqueeze(-1) * variance.sqrt()


def leverage(J: Tensor, posterior: Tensor) -> Tensor:
    """Variance J V J^T of every coordinate (...), m^2, from J (..., P) and V (P, P)."""
    return ((J @ posterior) * J).sum(-1)


def movements_of(groups: Tensor | None, count: int) -> Tensor:
    """Movement (count,) of each sample, numbered from 0: as they are told, or stretches where too few are.

    Args:
        groups: (count,) int64 that the recording tells; None where it tells none.
        count: Of samples, in the order of time.
    """
    if groups is not None:
        named, movement = groups.unique(return_inverse=True)
        if len(named) >= FEWEST:
            return movement
    return torch.arange(count) * min(STRETCHES, count) // count


def left_out(J: Tensor, weight: Tensor, residual: Tensor, size: float, movement: Tensor) -> LeftOut:
    """Leaves every movement out in turn.

    Args:
        J: (N, r, P) derivatives of the predicted coordinates by the scores, m.
        weight: (N, r) of the residuals.
        residual: (N, r) measured less predicted, m.
        size: Of a residual, m, as the fit weighs it.
        movement: (N,) from `movements_of`.
    """
    eye = torch.eye(J.shape[-1], dtype=J.dtype)
    scaled = weight.unsqueeze(-1) * J / size**2
    whole = J.flatten(0, 1).mT @ scaled.flatten(0, 1) + eye
    steps, error = [], torch.empty_like(residual)
    for number in range(int(movement.max()) + 1):
        own = (movement == number).nonzero()[:, 0]
        j, s, r = J[own].flatten(0, 1), scaled[own].flatten(0, 1), residual[own]
        # The fit's gradient is zero, so without the movement it is less the movement's own.
        step = -torch.linalg.solve(whole - j.mT @ s, s.mT @ r.flatten())
        steps.append(step)
        error[own] = r - (J[own] @ step)
    return LeftOut(torch.stack(steps), error)


def margins(error: Tensor, leverages: Tensor) -> Margins:
    """The most likely margins of k bodies, given the errors of left-out movements.

    Args:
        error: (N, k, 3) from `left_out`, m.
        leverages: (N, k, 3) from `leverage`, m^2.
    """
    found = []
    for body in range(error.shape[1]):
        e, v = error[:, body].flatten(), leverages[:, body].flatten()
        square = e.square().mean().clamp(min=1e-300)
        # Errors are never smaller than independent noise makes them: the wander is one or more.
        wander = torch.linspace(0.0, 5.0, 26, dtype=e.dtype).exp()
        floor = torch.linspace(-8.0, 0.5, 35, dtype=e.dtype).exp() * square
        variance = wander.view(-1, 1, 1) * v + floor.view(-1, 1)
        unlikely = (variance.log() + e.square() / variance).mean(-1)
        a, s = divmod(int(unlikely.argmin()), len(floor))
        # The next error is as likely as any of these to be the largest: the rank that conformal prediction takes.
        reach = (e.abs() / variance[a, s].sqrt()).quantile(min(_COVERED * (1.0 + 1.0 / len(e)), 1.0))
        found.append((float(wander[a]), math.sqrt(float(floor[s])), float(reach)))
    return Margins(*(torch.tensor(column, dtype=error.dtype) for column in zip(*found, strict=True)))


def student_95(freedom: float) -> float:
    """Deviations either side of the mean that hold 95 % of Student's distribution, from 5 degrees of freedom on.

    By its expansion about the normal distribution [Abramowitz and Stegun, 26.7.5], within 0.2 %.
    """
    z, n = NORMAL_95, freedom
    g1 = (z**3 + z) / 4.0
    g2 = (5.0 * z**5 + 16.0 * z**3 + 3.0 * z) / 96.0
    g3 = (3.0 * z**7 + 19.0 * z**5 + 17.0 * z**3 - 15.0 * z) / 384.0
    return z + g1 / n + g2 / n**2 + g3 / n**3
