"""Time as the runner sees it: the machine's monotonic clock, or a virtual one that only moves when it is waited for."""

from __future__ import annotations

import time
from abc import ABC, abstractmethod
from collections.abc import Callable


class Clock(ABC):
    """Seconds that never go back. Every stamp of a run comes from one clock."""

    @abstractmethod
    def now(self) -> float:
        """The time, s."""

    @abstractmethod
    def wait_until(self, deadline: float) -> None:
        """Returns at `deadline`, s, or at once if it has passed."""


class MonotonicClock(Clock):
    """`time.monotonic`, waited for by a sleep to just before the deadline and a short spin.

    Args:
        spin: How long before the deadline the sleep ends, s: a sleeping thread wakes tens of microseconds late.
    """

    def __init__(self, spin: float = 2e-4) -> None:
        self.spin = spin

    def now(self) -> float:
        """The time, s."""
        return time.monotonic()

    def wait_until(self, deadline: float) -> None:
        """Returns within microseconds after `deadline`, s, if the system lets it."""
        ahead = deadline - self.spin - time.monotonic()
        if ahead > 0:
            time.sleep(ahead)
        while time.monotonic() < deadline:
            pass


class VirtualClock(Clock):
    """Time that stands still while anything is computed, and jumps to what is waited for.

    Args:
        start: First time, s.

    Attributes:
        followers: Called with every new time, in order: a simulated arm follows its clock like this.
    """

    def __init__(self, start: float = 0.0) -> None:
        self.time = start
        self.followers: list[Callable[[float], None]] = []

    def now(self) -> float:
        """The time, s."""
        return self.time

    def wait_until(self, deadline: float) -> None:
        """Jumps to `deadline`, s, if it lies ahead."""
        if deadline > self.time:
            self.time = deadline
            for follow in self.followers:
                follow(deadline)
