"""Random numbers that are drawn beforehand: machine code draws none itself."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from apcc_torch.envs.streams import Stream


class Draw(NamedTuple):
    """One asking of a stream: so many numbers, uniform or normal."""

    normal: bool
    n: int


class Listed(NamedTuple):
    """A stream that notes what it is asked for, in order, as `draws`."""

    stream: Stream
    draws: list[Draw]

    @property
    def drawn(self) -> Tensor:
        """As `Stream.drawn`."""
        return self.stream.drawn

    def uniform(self, n: int, dtype: torch.dtype) -> tuple[Listed, Tensor]:
        """As `Stream.uniform`."""
        self.draws.append(Draw(False, n))
        later, numbers = self.stream.uniform(n, dtype)
        return Listed(later, self.draws), numbers

    def normal(self, n: int, dtype: torch.dtype) -> tuple[Listed, Tensor]:
        """As `Stream.normal`."""
        self.draws.append(Draw(True, n))
        later, numbers = self.stream.normal(n, dtype)
        return Listed(later, self.draws), numbers


class Prepared(NamedTuple):
    """Answers as the stream would that the numbers were drawn from.

    numbers: What each asking gets, (N, n), in order. drawn: (N,) int64, of the stream.
    """

    numbers: tuple[Tensor, ...]
    drawn: Tensor

    @classmethod
    def of(cls, stream: Stream, draws: Sequence[Draw], dtype: torch.dtype) -> tuple[Stream, Prepared]:
        """The stream after these askings, and what they get."""
        drawn, numbers = stream.drawn, []
        for draw in draws:
            stream, given = stream.normal(draw.n, dtype) if draw.normal else stream.uniform(draw.n, dtype)
            numbers.append(given)
        return stream, cls(tuple(numbers), drawn)

    def uniform(self, n: int, dtype: torch.dtype) -> tuple[Prepared, Tensor]:
        """The next numbers."""
        return Prepared(self.numbers[1:], self.drawn), self.numbers[0]

    def normal(self, n: int, dtype: torch.dtype) -> tuple[Prepared, Tensor]:
        """The next numbers."""
        return Prepared(self.numbers[1:], self.drawn), self.numbers[0]
