"""Tensor operations that put entries where they belong, known numbers among them."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor

from apcc_torch.native.scalars import INT
from apcc_torch.native.values import Arithmetic, Operator, Value, kind_of, mapped


def gather(a: Arithmetic, dtype: torch.dtype, x: Value, dim: int, index: Value, **_: object) -> Value:
    """Entries at places that may be known only later: a choice among all of them."""
    make, constant = a.scalars.make, a.scalars.constant
    places = index.entries.movedim(dim, -1)
    table = x.entries.movedim(dim, -1)
    table = table[tuple(slice(n) for n in places.shape[:-1])]
    columns = [table[..., i : i + 1].expand(places.shape) for i in range(table.shape[-1])]

    def choose(place: int, *row: int) -> int:
        chosen = row[0]
        for i, entry in enumerate(row[1:], 1):
            chosen = make("select", make("eq", place, constant(i, INT)), entry, chosen)
        return chosen

    return Value(mapped(choose, places, *columns).movedim(-1, dim), dtype)


def index(a: Arithmetic, dtype: torch.dtype, x: Value, indices: list[Value | None]) -> Value:
    """Places that are all known."""
    where = [None if i is None else known(a, i) for i in indices]
    return Value(x.entries[tuple(slice(None) if i is None else i for i in where)], dtype)


def known(a: Arithmetic, value: Value) -> Tensor:
    numbers = [a.scalars.known(i) for i in value.entries.flatten().tolist()]
    if any(n is None for n in numbers):
        raise NotImplementedError("an index that is known only at run time")
    return torch.tensor(numbers, dtype=value.dtype).reshape(value.entries.shape)


def pad(a: Arithmetic, dtype: torch.dtype, x: Value, pad: list[int], value: float = 0) -> Value:
    outside = a.scalars.constant(value, kind_of(dtype))
    return Value(torch.nn.functional.pad(x.entries, pad, value=outside), dtype)


def filled(a: Arithmetic, dtype: torch.dtype, shape: Any, value: float) -> Value:
    shape = tuple(shape.entries.shape) if isinstance(shape, Value) else tuple(shape)
    return Value(torch.full(shape, a.scalars.constant(value, kind_of(dtype)), dtype=torch.int64), dtype)


def filling(value: float) -> Operator:
    return lambda a, dtype, shape, *_, **__: filled(a, dtype, shape, value)


def triangle(side: str) -> Operator:
    def run(a: Arithmetic, dtype: torch.dtype, x: Value, diagonal: int = 0) -> Value:
        keep = torch.ones(x.entries.shape[-2:], dtype=torch.bool)
        keep = keep.tril(diagonal) if side == "lower" else keep.triu(diagonal)
        zero = torch.tensor(a.scalars.constant(0, kind_of(dtype)))
        return Value(torch.where(keep, x.entries, zero), dtype)

    return run


def embedded(a: Arithmetic, dtype: torch.dtype, x: Value, *args: int) -> Value:
    zero = a.scalars.constant(0, kind_of(dtype))
    # Indices are moved as they are and the rest filled: 0 is an index too, so they are told apart by a shift.
    moved = torch.diag_embed(x.entries + 1, *args)
    return Value(torch.where(moved == 0, torch.tensor(zero + 1), moved) - 1, dtype)


def scattered(a: Arithmetic, dtype: torch.dtype, x: Value, y: Value, *args: int, **named: int) -> Value:
    return Value(torch.diagonal_scatter(x.entries, y.entries.contiguous(), *args, **named), dtype)


def known_tensor(function: Callable[..., Tensor]) -> Operator:
    """A tensor made from numbers alone."""

    def run(a: Arithmetic, dtype: torch.dtype, *args: Any, **_: object) -> Value:
        return a.constant(function(*args, dtype=dtype))

    return run
