"""Times of many turns in a memory that does not grow: exact at first, and to half a percent from then on."""

from __future__ import annotations

from math import exp, inf, log, nan

import numpy as np

EXACT = 10_000
"""So many times are kept as they are."""
LEAST, WIDTH, BINS = 1e-7, 0.01, 2304
"""Of the bins after that: least time that is told from none, s, and their width, a hundredth; the last is 1000 s."""


class StageTimes:
    """The percentiles of times that come one by one.

    Attributes:
        count: How many came. largest: s, the largest of them, exactly.

    Example:
        >>> times = StageTimes()
        >>> for k in range(50_001):
        ...     times.add(2e-6 * k)
        >>> abs(times.percentile(50) - 0.05) < 0.006 * 0.05, times.largest
        (True, 0.1)
    """

    def __init__(self) -> None:
        self.count = 0
        self.largest = -inf
        # Written to at once: memory that is only reserved would look as if it grew.
        self.first = np.full(EXACT, nan)
        self.bins = np.full(BINS, 0, dtype=np.int64)

    def add(self, seconds: float) -> None:
        """One more time, s."""
        if self.count < EXACT:
            self.first[self.count] = seconds
        self.bins[0 if seconds <= LEAST else min(1 + int(log(seconds / LEAST) / WIDTH), BINS - 1)] += 1
        self.count += 1
        self.largest = max(self.largest, seconds)

    def percentile(self, share: float) -> float:
        """The time, s, that `share` percent do not exceed; NaN where none came."""
        if self.count <= EXACT:
            return float(np.percentile(self.first[: self.count], share)) if self.count else nan
        place = int(np.searchsorted(np.cumsum(self.bins), share / 100 * self.count))
        return min(LEAST * exp(WIDTH * (place - 0.5)), self.largest)
