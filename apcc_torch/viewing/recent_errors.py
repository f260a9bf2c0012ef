"""The error of the last seconds, as a plot shows it."""

from __future__ import annotations

from collections import deque

import numpy as np

from apcc_torch.viewing.moment import Array

KEPT = 20.0
"""s that are kept."""


class RecentErrors:
    """Errors of a run that goes on, with their times.

    Example:
        >>> errors = RecentErrors()
        >>> for time in (0.0, 15.0, 15.0, 30.0):
        ...     errors.keep(time, 2.0)
        >>> errors.curve()[0].tolist()
        [15.0, 30.0]
    """

    def __init__(self) -> None:
        self.times: deque[float] = deque()
        self.errors: deque[float] = deque()

    def keep(self, time: float, error: float) -> None:
        """Takes the error at a time, s, that is later than the last one; an earlier one is passed over."""
        if self.times and time <= self.times[-1]:
            return
        self.times.append(time)
        self.errors.append(error)
        while self.times[-1] - self.times[0] > KEPT:
            self.times.popleft()
            self.errors.popleft()

    def clear(self) -> None:
        """Forgets all."""
        self.times.clear()
        self.errors.clear()

    def curve(self) -> tuple[Array, Array]:
        """Times (N,), s, and errors (N,)."""
        return np.array(self.times), np.array(self.errors)
