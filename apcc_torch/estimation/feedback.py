"""What algorithm 2 returns: the configuration that it infers, how well it fits, and how each row ended."""

from __future__ import annotations

from enum import IntEnum
from typing import NamedTuple

import torch
from torch import Tensor

from apcc_torch.estimation.fit import Problem


class FeedbackStatus(IntEnum):
    """How a row of the estimate ended.

    Example:
        >>> FeedbackStatus(1)
        <FeedbackStatus.SETTLED: 1>
    """

    CONVERGED = 0
    """Every sensor is within both thresholds."""
    SETTLED = 1
    """The step became negligible with a residual above the thresholds: nearby, the model fits no better. Of a
    `ShapeFeedback` only where no sensor is ten standard deviations off from the arm's own shape."""
    ITERATION_LIMIT = 2
    """The iterations ran out first. A `ShapeFeedback` takes one a sample: its status is this until the arm rests."""
    INVALID = 3
    """No usable sensor, one whose pose is no pose, a non-finite seed, or a rest length that is not positive and finite:
    q_bar is the seed, and the controller holds its command."""
    MISFIT = 4
    """The step became negligible far from the sensors: another branch of the shape, or another arm."""
    UNTOLD = 5
    """Of a `ShapeFeedback`: what is measured leaves a section to what was believed before; see `LoadedShape.untold`."""


class Feedback(NamedTuple):
    """Result of algorithm 2.

    q_bar: (..., n) inferred configuration.
    angular_error: (..., k) norm of the angular part of Eq. (30), rad; 0 for a sensor that is masked.
    linear_error: (..., k) norm of the linear part of Eq. (30), or of Eq. (32) outside mode "pose", m; 0 for a sensor
        that is masked.
    iterations: (...) int64 steps computed.
    status: (...) int64 `FeedbackStatus`.

    Example:
        >>> arm = Arm(lengths=[0.2, 0.25])
        >>> backbone, L0, X = arm.backbone(), arm.rest_lengths(), arm.sensor_places()
        >>> seen = backbone.pose(torch.full((6,), 0.01).double(), L0, *decouple(X, L0))
        >>> feedback = StateFeedback(backbone, X)(torch.zeros(6).double(), L0, seen)
        >>> feedback.q_bar, FeedbackStatus(int(feedback.status)).name
        (tensor([0.0100, 0.0100, 0.0100, 0.0100, 0.0100, 0.0100], dtype=torch.float64), 'CONVERGED')
    """

    q_bar: Tensor
    angular_error: Tensor
    linear_error: Tensor
    iterations: Tensor
    status: Tensor


class Inference(NamedTuple):
    """Algorithm 2's result with what the derivatives at its end need of it.

    feedback: The result.
    pi_hat: (..., n_b) the parameters it was inferred with, m.
    problem: The sensors.
    """

    feedback: Feedback
    pi_hat: Tensor
    problem: Problem


def status_of(
    like: Tensor, within: Tensor, settled: Tensor, far: Tensor, valid: Tensor, untold: Tensor | None = None
) -> Tensor:
    """(...) `FeedbackStatus`, of the dtype of `like`, of rows that are so; None for no row."""
    status = torch.full_like(like, int(FeedbackStatus.ITERATION_LIMIT))
    status = status.masked_fill(settled, int(FeedbackStatus.SETTLED))
    status = status.masked_fill(settled & far, int(FeedbackStatus.MISFIT))
    status = status.masked_fill(within, int(FeedbackStatus.CONVERGED))
    if untold is not None:
        status = status.masked_fill(untold & (within | ~(settled & far)), int(FeedbackStatus.UNTOLD))
    return status.masked_fill(~valid, int(FeedbackStatus.INVALID))
