"""What comes of a step of an environment: what is seen then, what it earned, and why a row ends."""

from __future__ import annotations

from enum import IntEnum
from typing import NamedTuple

from torch import Tensor


class TruncatedReason(IntEnum):
    """Why a row was truncated.

    Example:
        >>> TruncatedReason(1)
        <TruncatedReason.TIME_LIMIT: 1>
    """

    NONE = 0
    TIME_LIMIT = 1
    NOT_FINITE = 2
    """The action or the arm's state is not a number: the row stays where it was."""
    DIVERGED = 3
    """The arm's state left its bounds: the row stays where it was. Or the controller's model did, see `Divergence`."""


class View(NamedTuple):
    """What a state looks like: observation (N, o) float32, and the task's error (N,) m."""

    observation: Tensor
    error: Tensor


class Outcome(NamedTuple):
    """What came of a step: the view after it, reward (N,) float32, truncated (N,) bool, reason (N,) int64."""

    view: View
    reward: Tensor
    truncated: Tensor
    reason: Tensor
