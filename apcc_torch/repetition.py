"""Repetition of a step on its own result, which machine code writes once."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from typing import Any, TypeVar

import torch
from torch import Tensor

from apcc_torch.modes import none_left

S = TypeVar("S")
Repeat = Callable[[Callable[[Any], Any], Any, int, Callable[[Any], Tensor]], Any]

_recording: ContextVar[Repeat | None] = ContextVar("_recording", default=None)


def repeated(body: Callable[[S], S], state: S, times: int, going: Callable[[S], Tensor]) -> S:
    """The state after `body` was called on it so many times, or fewer once no row is going.

    Args:
        body: From a state to the next, of the same form and types, without branches on values. A row that is not going
            may change only in what no longer counts.
        state: (Nested) tuples of tensors.
        times: Most calls.
        going: (...) bool, the rows that have not ended, of a state.

    Example:
        >>> large = torch.tensor([7.0, 0.3])
        >>> repeated(lambda x: torch.where(x > 1.0, 0.5 * x, x), large, 9, lambda x: x > 1.0)
        tensor([0.8750, 0.3000])
    """
    recording = None if torch.compiler.is_dynamo_compiling() else _recording.get()
    if recording is not None:
        outcome: S = recording(body, state, times, going)
        return outcome
    for _ in range(times):
        if none_left(going(state)):
            break
        state = body(state)
    return state


@contextmanager
def recorded_by(repeat: Repeat) -> Iterator[None]:
    """Inside, `repeat` answers for `repeated`: it writes down what is done, in place of doing it."""
    before = _recording.set(repeat)
    try:
        yield
    finally:
        _recording.reset(before)
