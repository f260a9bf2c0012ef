"""What a fit knows of every parameter and of what it predicts, and which combinations it does not know."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from apcc_torch.identification.fit import Fit, sensitivity
from apcc_torch.identification.left_out import student_95
from apcc_torch.identification.parameters import Parameters
from apcc_torch.identification.tendon_arm import Drive, TendonArm

_AT_ONCE = 500
"""Moments whose derivatives are held at once."""


class Interval(NamedTuple):
    """One fitted parameter.

    name: Such as "offset: tendon 3". unit: Of the next four.
    nominal: Before the fit. value: After it. low, high: 95 % confidence interval.
    learned: Share of the variance before the fit that the data removed: 1 all, 0 nothing, or less than that.
    """

    name: str
    unit: str
    nominal: float
    value: float
    low: float
    high: float
    learned: float


class Direction(NamedTuple):
    """A combination of parameters that the data say less about than was believed before.

    information: Of the data, along it, over that of the belief: below one.
    parts: Its largest components: (parameter, weight), the weights' squares summing to one over all parameters.
    """

    information: float
    parts: tuple[tuple[str, float], ...]


def intervals(parameters: Parameters, fit: Fit) -> list[Interval]:
    """Every fitted parameter with its 95 % interval; those of positive parameters are never negative.

    Student's, as the covariance is told by so many movements alone.
    """
    deviation = fit.covariance.diagonal().clamp(min=0.0).sqrt()
    reach = student_95(max(fit.movements - 1, 1)) * deviation
    ends = [parameters.values(fit.z + side * reach) for side in (0.0, -1.0, 1.0)]
    rows, index = [], 0
    for name, block in parameters.blocks.items():
        for i, label in enumerate(block.labels):
            if block.spread[i] == 0:
                continue
            value, low, high = (float(end[name][i]) for end in ends)
            learned = max(1.0 - float(deviation[index]) ** 2, 0.0)
            rows.append(Interval(f"{name}: {label}", block.unit, float(block.nominal[i]), value, low, high, learned))
            index += 1
    return rows


def half_widths(arm: TendonArm, parameters: Parameters, drive: Drive, fit: Fit) -> Tensor:
    """Half of the 95 % prediction interval of every coordinate (N, k, 3), m; NaN where there is no equilibrium.

    It is of what will be measured, not of a mean: what the model leaves unexplained is in it.

    Args:
        arm, parameters: What was fitted.
        drive: What drives the arm at N moments.
        fit: The fit.
    """
    values, posterior, parts = parameters.values(fit.z), fit.posterior, []
    for index in torch.arange(len(drive.ages)).split(_AT_ONCE):
        some = drive.rows(index)
        J = sensitivity(arm, parameters, some, fit.z, arm.rest(some, values))
        parts.append(fit.margins.half_width(J, posterior))
    return torch.cat(parts)


def coverage(predicted: Tensor, half_width: Tensor, measured: Tensor) -> Tensor:
    """Share (k,) of the coordinates of each body (N, k, 3) that lie within their intervals."""
    return ((measured - predicted).abs() <= half_width).double().mean((0, 2))


def unknown_directions(parameters: Parameters, fit: Fit, parts: int = 4) -> list[Direction]:
    """Combinations that are known no better after the fit than before it, the least known first."""
    information, vectors = torch.linalg.eigh(fit.information)
    names = parameters.names
    rows = []
    for k in (information < 1.0).nonzero()[:, 0].tolist():
        largest = vectors[:, k].abs().argsort(descending=True)[:parts].tolist()
        weights = tuple((names[i], float(vectors[i, k])) for i in largest)
        rows.append(Direction(max(float(information[k]), 0.0), weights))
    return rows


def disagreement(first: Fit, second: Fit) -> float:
    """How far two fits to different samples differ, in the standard deviations that their intervals expect.

    Root of the mean square over the combinations that the data know better than the belief before the fit: about one
    where the intervals are right, more where they are too narrow.
    """
    values, vectors = torch.linalg.eigh(first.information + second.information)
    known = vectors[:, values > 2.0]
    if not known.shape[1]:
        return 0.0
    difference = known.mT @ (first.z - second.z)
    expected = (known * ((first.covariance + second.covariance) @ known)).sum(0)
    return float((difference.square() / expected).mean().sqrt())
