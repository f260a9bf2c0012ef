"""Warnings that a stream of bad packets cannot turn into a flood."""

from __future__ import annotations

import logging
import time


class LimitedLog:
    """Logs each kind of warning at most once per interval, and says how many were left out.

    Args:
        log: Where the warnings go.
        interval: s.
    """

    def __init__(self, log: logging.Logger, interval: float = 1.0) -> None:
        self._log, self._interval = log, interval
        self._next: dict[str, float] = {}
        self._left_out: dict[str, int] = {}

    def warning(self, kind: str, message: str, *values: object, trace: bool = False) -> None:
        """Logs `message % values`, unless this kind has been logged within the interval.

        Args:
            kind: What shares one limit.
            message: The sentence.
            values: What it is filled with.
            trace: Whether the exception being handled is shown with its stack.
        """
        now = time.monotonic()
        if now < self._next.get(kind, now):
            self._left_out[kind] = self._left_out.get(kind, 0) + 1
            return
        self._next[kind] = now + self._interval
        left_out = self._left_out.pop(kind, 0)
        more = f" ({left_out} more like it)" if left_out else ""
        self._log.warning(message + "%s", *values, more, exc_info=trace)
