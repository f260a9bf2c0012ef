"""What algorithm 2 returns: the configuration that it infers, how well it fits, and how each row ended."""

from __future__ import annotations

from enum import IntEnum
from typing import NamedTuple

from torch import Tensor

from apcc_torch.estimation.fit import Problem


class FeedbackStatus(IntEnum):
    """How a row of the estimate ended."""

    CONVERGED = 0
    """Every sensor is within both thresholds."""
    SETTLED = 1
    """The step became negligible with a residual above the thresholds: the model cannot fit the sensors better."""
    ITERATION_LIMIT = 2
    """The iterations ran out first."""
    INVALID = 3
    """No usable sensor, or a non-finite seed or parameter: q_bar is the seed."""


class Feedback(NamedTuple):
    """Result of algorithm 2.

    q_bar: (..., n) inferred configuration.
    angular_error: (..., k) norm of the angular part of Eq. (30), rad; 0 for a sensor that is masked.
    linear_error: (..., k) norm of the linear part of Eq. (30), or of Eq. (32) outside mode "pose", m; 0 for a sensor
        that is masked.
    iterations: (...) int64 steps computed.
    status: (...) int64 `FeedbackStatus`.
    """

    q_bar: Tensor
    angular_error: Tensor
    linear_error: Tensor
    iterations: Tensor
    status: Tensor


class Inference(NamedTuple):
    """Algorithm 2's result with what `StateFeedback.followed` needs of it.

    feedback: The result.
    pi_hat: (..., n_b) the parameters it was inferred with, m.
    problem: The sensors.
    """

    feedback: Feedback
    pi_hat: Tensor
    problem: Problem
