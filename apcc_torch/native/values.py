"""Tensors whose entries are scalar expressions: what a traced function computes with."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import torch
from torch import Tensor

from apcc_torch.native.scalars import BOOL, FLOAT, INT, Held, Scalars


def kind_of(dtype: torch.dtype) -> str:
    """The kind of expression that holds an entry of this type."""
    return FLOAT if dtype.is_floating_point else BOOL if dtype == torch.bool else INT


class Value(NamedTuple):
    """A tensor of expressions.

    entries: int64 tensor of indices into the scalars; moving entries about is moving indices about.
    dtype: Of the tensor that it stands for.
    """

    entries: Tensor
    dtype: torch.dtype


Operand = Value | float | int | bool

Operator = Callable[..., Any]
"""A tensor operation: (arithmetic, the result's type, arguments, keywords) to a value, or to several."""


class Arithmetic:
    """Entrywise arithmetic on values."""

    def __init__(self) -> None:
        self.scalars = Scalars()
        self._tensors = 0

    def constant(self, tensor: Tensor) -> Value:
        """A tensor that is known now."""
        kind = kind_of(tensor.dtype)
        flat = [self.scalars.constant(value, kind) for value in tensor.detach().flatten().tolist()]
        return Value(torch.tensor(flat, dtype=torch.int64).reshape(tensor.shape), tensor.dtype)

    def held(self, tensor: Tensor, number: int | None = None) -> Value:
        """A tensor that the function holds, each entry a number of its own; see `Scalars.held`.

        Args:
            tensor: Its values.
            number: Of a tensor that the function is known to hold.
        """
        if kind_of(tensor.dtype) != FLOAT:
            return self.constant(tensor)
        self._tensors += 1
        flat = []
        for k, value in enumerate(tensor.detach().flatten().tolist()):
            at = None if number is None else Held(number, k)
            flat.append(self.scalars.held(value, f"{self._tensors}.{k}", at))
        return Value(torch.tensor(flat, dtype=torch.int64).reshape(tensor.shape), tensor.dtype)

    def entries(self, operand: Operand, kind: str) -> Tensor:
        """An operand's expressions as numbers of a kind."""
        if not isinstance(operand, Value):
            return torch.tensor(self.scalars.constant(operand, kind))
        have = kind_of(operand.dtype)
        if have == kind:
            return operand.entries
        return mapped(lambda i: self.converted(i, have, kind), operand.entries)

    def converted(self, index: int, have: str, want: str) -> int:
        """An expression of one kind as one of another."""
        make, constant = self.scalars.make, self.scalars.constant
        if have == want:
            return index
        if want == BOOL:
            return make("ne", index, constant(0, have))
        if have == BOOL:
            return make("select", index, constant(1, want), constant(0, want))
        return make("float" if want == FLOAT else "int", index)

    def entrywise(self, op: Callable[..., int], operands: list[Operand], kind: str, dtype: torch.dtype) -> Value:
        """`op` of broadcast operands, each taken as `kind`."""
        return Value(mapped(op, *(self.entries(operand, kind) for operand in operands)), dtype)

    def total(self, indices: list[int]) -> int:
        """Sum of expressions, one after the other."""
        return self.folded("add", indices)

    def folded(self, op: str, indices: list[int]) -> int:
        """op(op(a, b), c), ..."""
        result = indices[0]
        for index in indices[1:]:
            result = self.scalars.make(op, result, index)
        return result


def mapped(op: Callable[..., int], *entries: Tensor) -> Tensor:
    """`op` on the entries of broadcast index tensors."""
    shaped = torch.broadcast_tensors(*entries)
    flat = [op(*row) for row in zip(*(t.flatten().tolist() for t in shaped), strict=True)]
    return torch.tensor(flat, dtype=torch.int64).reshape(shaped[0].shape)
