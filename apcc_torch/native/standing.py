"""Calls on memory that stays where it is: what a loop in real time writes into, runs, and reads from."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from apcc_torch.errors import CompileError
from apcc_torch.native.function import NativeFunction
from apcc_torch.native.structure import described, flattened, rebuilt

_ALIGNED = 64
"""Bytes: where every array begins on a multiple of this, none shares a cache line or a vector with another."""


class StandingCall:
    """A step whose arguments and results are arrays that stay in place.

    A call costs what the step costs and a few microseconds: no tensor is made, checked or taken apart.

    Args:
        step: Machine code, or any function of (nested tuples of) tensors, which is then called on tensors of the same
            memory.
        example: Its arguments; they are the first that stand.
        carries: The first result (or the only one) becomes the first argument after each call.

    Attributes:
        given: The arguments, as arrays to write into: `given[1][...] = value`.
        results: The results of the last call, as arrays that the next call overwrites.

    Raises:
        CompileError: What is carried has not the form of the first argument; of a function its first call says so.

    Example:
        >>> count = StandingCall(lambda total, x: total + x, (torch.tensor(0.0), torch.tensor(2.0)), carries=True)
        >>> count(), count(), float(count.results)
        (None, None, 4.0)
    """

    def __init__(self, step: Callable[..., Any], example: tuple[Any, ...], carries: bool = False) -> None:
        self._step = step
        self._carried = example[0] if carries else None
        given, self._state = _standing(flattened(example), len(flattened(self._carried)))
        tensors = [torch.from_numpy(array) for array in given]
        self._arguments = rebuilt(example, iter(tensors))
        self.given: Any = rebuilt(example, iter(given))
        self.results: Any = None
        self._flat: list[NDArray[Any]] = []
        self._bound: Callable[[], None] | None = None
        if isinstance(step, NativeFunction):
            self._hold(step.blank(tensors))
            self._bound = step.bound(tensors, [torch.from_numpy(array) for array in self._flat])

    def _hold(self, like: Any) -> None:
        """Makes room for results of this form."""
        if self._carried is not None:
            now, later = described(self._carried), described(like[0] if type(like) is tuple else like)
            if now != later:
                raise CompileError(f"what is carried must come back as it went in: {now} became {later}")
        self._flat, self._next = _standing(flattened(like), len(flattened(self._carried)))
        self.results = rebuilt(like, iter(self._flat))

    def __call__(self) -> None:
        """Runs the step on what stands in `given`."""
        if self._bound is not None:
            self._bound()
        else:
            outcome = self._step(*self._arguments)
            if self.results is None:
                self._hold(outcome)
            for array, result in zip(self._flat, flattened(outcome), strict=True):
                np.copyto(array, result.detach().numpy())
        np.copyto(self._state, self._next)


def _standing(values: list[Tensor], together: int) -> tuple[list[NDArray[Any]], NDArray[np.uint8]]:
    """Copies of tensors in one piece of memory, and the part of it that holds the first so many."""
    starts, size = [], 0
    for value in values:
        starts.append(size)
        size += -(-value.numel() * value.element_size() // _ALIGNED) * _ALIGNED
    memory = np.zeros(size + _ALIGNED, dtype=np.uint8)
    memory = memory[-memory.ctypes.data % _ALIGNED :][:size]
    arrays = []
    for value, start in zip(values, starts, strict=True):
        source = value.detach().cpu().numpy()
        array = memory[start : start + source.nbytes].view(source.dtype).reshape(source.shape)
        np.copyto(array, source)
        arrays.append(array)
    return arrays, memory[: [*starts, size][together]]
