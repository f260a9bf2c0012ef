"""Beside what a controller cannot look ahead, and the one sentence that says so."""

from __future__ import annotations

from enum import Enum

from apcc_torch.errors import ConfigError


class LookaheadRefusal(Enum):
    """Where there is no look ahead, and why.

    Example:
        >>> LookaheadRefusal.LIBRARY.check(False)
        >>> LookaheadRefusal.LIBRARY.check(True)
        Traceback (most recent call last):
        apcc_torch.errors.ConfigError: lookahead must be none in an exported library: it holds no rollouts
    """

    NO_TENDONS = "without a tendon routing", "its rollouts are of tendons"
    CHAMBERS = "where arm.chambers are given", "its rollouts are of tendons"
    MODEL = "where model is not pcc", "its rollouts are of sections of constant curvature"
    ROWS = "where its settings or the controller's differ from row to row", "its rollouts have one model for all rows"
    DYNAMICS_LAW = "beside dynamics_law", "its rollouts know no feed-forward of forces"
    LIBRARY = "in an exported library", "it holds no rollouts"
    KINEMATIC = "where dynamics is kinematic", "its rollouts are of an arm with forces"
    NO_CONTROLLER = "where action is not adaptation", "no controller drives the arm"

    def check(self, wrong: bool) -> None:
        """Raises ConfigError where this is the case, and there is to be a look ahead."""
        if wrong:
            where, why = self.value
            raise ConfigError(f"lookahead must be none {where}: {why}")
