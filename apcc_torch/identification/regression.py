"""What a prediction without a model of the arm reaches: the mean, and linear regression."""

from __future__ import annotations

import torch
from torch import Tensor


def mean_prediction(positions: Tensor, count: int) -> Tensor:
    """The mean of the training positions (N, k, 3), for `count` samples."""
    return positions.mean(0).expand(count, *positions.shape[1:])


def linear_prediction(inputs: Tensor, positions: Tensor, wanted: Tensor) -> Tensor:
    """Least squares of the positions (N, k, 3) by the inputs (N, m) and a constant, at the inputs `wanted` (M, m)."""

    def with_constant(values: Tensor) -> Tensor:
        return torch.nn.functional.pad(values, (0, 1), value=1.0)

    coefficients = torch.linalg.lstsq(with_constant(inputs), positions.flatten(1), driver="gelsd").solution
    return (with_constant(wanted) @ coefficients).unflatten(-1, positions.shape[1:])
