"""From the server's clock to `time.monotonic()`, by the packets that were the least delayed.

Every packet tells that the clocks' difference (ours minus the server's) is at most its arrival minus its sending: the
delay is never negative. The estimate is the least such bound so far, and may rise only as fast as two clocks can drift
apart. It follows drift in either direction, and a queue that delays every packet for minutes does not move it, so late
packets are seen to be late. What it cannot see is the part of the delay that even the fastest packet has: on a wired
network 0.1 to 0.3 ms.
"""

from __future__ import annotations

import math


class ClockMap:
    """Running minimum-delay estimate of the difference of two clocks.

    A bound that lies far below the estimate, or far above it with a server clock that went back, is a clock that was
    set or a damaged stamp. It counts only when `confirm` packets in a row agree on it; until then the estimate stands.

    Args:
        max_drift: Limit of how fast the clocks drift apart, s/s.
        step: A change of more than this is a step, s.
        confirm: Number of packets that confirm a step.
    """

    def __init__(self, max_drift: float, step: float, confirm: int) -> None:
        self._max_drift, self._step, self._confirm = max_drift, step, confirm
        self.steps = 0
        self.offset: float | None = None
        self._arrival = -math.inf
        self._sent = -math.inf
        self._doubted: float | None = None
        self._doubts = 0

    def update(self, sent: float, arrival: float) -> None:
        """Takes one packet in.

        Args:
            sent: When it was sent, s of the server's clock.
            arrival: When it came, s of ours.
        """
        bound = arrival - sent
        if self.offset is None:
            self._start(bound, sent, arrival)
            return
        went_back = sent < self._sent - self._step or self._doubts > 0
        doubtful = bound < self.offset - self._step or (bound > self.offset + self._step and went_back)
        if doubtful:
            self._doubt(bound, sent, arrival)
            return
        self._doubts = 0
        drifted = self.offset + self._max_drift * max(0.0, arrival - self._arrival)
        self.offset = min(drifted, bound)
        self._arrival, self._sent = arrival, max(self._sent, sent)

    def stamp(self, measured: float, arrival: float) -> float:
        """A time of the server's clock in ours, s; never after the packet's arrival, which is all that is sure."""
        return arrival if self.offset is None else min(measured + self.offset, arrival)

    def reset(self) -> None:
        """Forgets the estimate."""
        self.offset, self._doubts = None, 0

    def _start(self, bound: float, sent: float, arrival: float) -> None:
        self.offset, self._arrival, self._sent, self._doubts = bound, arrival, sent, 0

    def _doubt(self, bound: float, sent: float, arrival: float) -> None:
        agrees = self._doubts > 0 and self._doubted is not None and abs(bound - self._doubted) <= self._step
        self._doubts = self._doubts + 1 if agrees else 1
        self._doubted = bound
        if self._doubts >= self._confirm:
            self.steps += 1
            self._start(bound, sent, arrival)
