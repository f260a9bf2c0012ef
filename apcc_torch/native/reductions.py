"""Tensor operations along dimensions: sums, extremes, norms."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import torch

from apcc_torch.native.entrywise import entrywise, square
from apcc_torch.native.scalars import FLOAT, INT
from apcc_torch.native.values import Arithmetic, Operator, Value, kind_of


def _dimensions(dim: int | list[int] | None, rank: int) -> list[int]:
    given = range(rank) if dim is None or dim == [] else [dim] if isinstance(dim, int) else dim
    return sorted(d % max(rank, 1) for d in given)


def reduced(fold: Callable[[Arithmetic, list[int]], int], empty: float | None = None) -> Operator:
    """A reduction over dimensions, by a rule for one list of expressions."""

    def run(
        a: Arithmetic, dtype: torch.dtype, x: Value, dim: int | list[int] | None = None, keepdim: bool = False,
        **_: object,
    ) -> Value:  # fmt: skip
        entries = a.entries(x, kind_of(dtype))
        rank = entries.dim()
        dims = _dimensions(dim, rank)
        kept = [d for d in range(rank) if d not in dims]
        lists = entries.permute([*kept, *dims]).reshape(*[entries.shape[d] for d in kept], -1)
        if lists.shape[-1] == 0:
            assert empty is not None
            flat = [a.scalars.constant(empty, kind_of(dtype))] * lists[..., 0:1].sum(-1).numel()
        else:
            flat = [fold(a, row) for row in lists.reshape(-1, lists.shape[-1]).tolist()]
        shape = [1 if d in dims else entries.shape[d] for d in range(rank)] if keepdim else lists.shape[:-1]
        return Value(torch.tensor(flat, dtype=torch.int64).reshape(shape), dtype)

    return run


def mean(a: Arithmetic, row: list[int]) -> int:
    return a.scalars.make("div", a.total(row), a.scalars.constant(len(row), FLOAT))


def norm(a: Arithmetic, dtype: torch.dtype, x: Value, ord: float = 2, dim: Any = None, keepdim: bool = False) -> Value:
    if ord != 2:
        raise NotImplementedError(f"a norm of order {ord}")
    squared = square(a, dtype, x)
    return entrywise("sqrt", FLOAT)(a, dtype, SUM(a, dtype, squared, dim, keepdim))


def cumsum(a: Arithmetic, dtype: torch.dtype, x: Value, dim: int) -> Value:
    entries = a.entries(x, kind_of(dtype)).movedim(dim, -1)
    rows = entries.reshape(-1, entries.shape[-1]).tolist()
    for row in rows:
        for i in range(1, len(row)):
            row[i] = a.scalars.make("add", row[i - 1], row[i])
    return Value(torch.tensor(rows, dtype=torch.int64).reshape(entries.shape).movedim(-1, dim), dtype)


def argmax(op: str) -> Operator:
    """Index of the first largest (or smallest) entry along a dimension."""

    def run(a: Arithmetic, dtype: torch.dtype, x: Value, dim: int | None = None, keepdim: bool = False) -> Value:
        make, constant = a.scalars.make, a.scalars.constant

        def first(a: Arithmetic, row: list[int]) -> int:
            best, place = row[0], constant(0, INT)
            for i, entry in enumerate(row[1:], 1):
                better = make("lt", best, entry) if op == "max" else make("lt", entry, best)
                best, place = make("select", better, entry, best), make("select", better, constant(i, INT), place)
            return place

        result = reduced(first)(a, x.dtype, x, dim, keepdim)
        return Value(result.entries, dtype)

    return run


SUM = reduced(lambda a, row: a.total(row), 0.0)
"""Of no entries it is zero."""
