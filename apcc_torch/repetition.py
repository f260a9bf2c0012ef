"""What a program does again, on its own result or at several places, and machine code writes once."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from typing import Any, Protocol, TypeVar

import torch
from torch import Tensor

from apcc_torch.modes import none_left

S = TypeVar("S")


class Recording(Protocol):
    """What writes down what is done, in place of doing it."""

    def repeated(self, body: Callable[[Any], Any], state: Any, times: int, going: Callable[[Any], Tensor]) -> Any:
        """See `repeated`."""
        ...

    def shared(self, function: Callable[..., Any], args: tuple[Any, ...]) -> Any:
        """See `shared`."""
        ...


_recording: ContextVar[Recording | None] = ContextVar("_recording", default=None)


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
    recording = _recorder()
    if recording is not None:
        outcome: S = recording.repeated(body, state, times, going)
        return outcome
    for _ in range(times):
        if none_left(going(state)):
            break
        state = body(state)
    return state


def shared(function: Callable[..., S], *args: Any) -> S:
    """function(*args); machine code writes the function once and calls it wherever it is shared with the like.

    Worth it for what takes thousands of operations and is done several times in one step.

    Args:
        function: Of its arguments alone, without branches on values, such as a method of a module.
        *args: (Nested) tuples of tensors, numbers and None.

    Example:
        >>> shared(torch.add, torch.tensor(1.0), torch.tensor(2.0))
        tensor(3.)
    """
    recording = _recorder()
    if recording is None:
        return function(*args)
    outcome: S = recording.shared(function, args)
    return outcome


def _recorder() -> Recording | None:
    return None if torch.compiler.is_dynamo_compiling() else _recording.get()


@contextmanager
def recorded_by(recording: Recording) -> Iterator[None]:
    """Inside, `recording` answers for `repeated` and `shared`."""
    before = _recording.set(recording)
    try:
        yield
    finally:
        _recording.reset(before)
