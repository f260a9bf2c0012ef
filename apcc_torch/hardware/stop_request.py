"""Ctrl-C, SIGTERM and a closed terminal as wishes that the loop sees at its next tick, never as an exception in it."""

from __future__ import annotations

import signal
from collections.abc import Iterator
from contextlib import contextmanager
from types import FrameType

from apcc_torch.hardware.stops import Stop, StopReason

SIGNALS = {
    signal.SIGINT: StopReason.INTERRUPTED,
    signal.SIGTERM: StopReason.TERMINATED,
    signal.SIGHUP: StopReason.TERMINATED,
}


class StopRequest:
    """How often, and by what, the run was asked to stop. The first request stops it, the second ends its hold."""

    def __init__(self) -> None:
        self.count = 0
        self.stop: Stop | None = None

    def ask(self, reason: StopReason, message: str) -> None:
        """One more request; the first one's reason stays."""
        self.count += 1
        if self.stop is None:
            self.stop = Stop(reason, message)

    @contextmanager
    def on_signals(self) -> Iterator[StopRequest]:
        """Takes the signals over for a while. In the main thread only, as Python has it."""

        def handle(number: int, frame: FrameType | None) -> None:
            self.ask(SIGNALS[signal.Signals(number)], f"received {signal.Signals(number).name}")

        before = {number: signal.signal(number, handle) for number in SIGNALS}
        try:
            yield self
        finally:
            for number, handler in before.items():
                signal.signal(number, handler)
