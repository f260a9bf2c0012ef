"""How a long loop reports its progress: by a wrapper around its steps, such as a progress bar."""

from __future__ import annotations

from collections.abc import Callable, Iterable

Progress = Callable[[Iterable[int]], Iterable[int]]


def quiet(steps: Iterable[int]) -> Iterable[int]:
    """Reports nothing."""
    return steps
