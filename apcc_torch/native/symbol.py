"""Tensors of a trace: each entry is an expression."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from apcc_torch.native.values import Value


class Symbol(Tensor):
    """A tensor of expressions: it has a form, but no values that could be read or branched on.

    value: Its expressions.
    row: The tensor at the example, which tells torch's forms.
    """

    value: Value
    row: Tensor
    __torch_function__ = torch._C._disabled_torch_function_impl  # type: ignore[assignment]

    @classmethod
    def __torch_dispatch__(  # type: ignore[override]
        cls, func: Any, types: Any, args: Any = (), kwargs: Any = None
    ) -> Any:
        raise RuntimeError(f"{func} met a tensor of a trace that has ended")


def symbol(value: Value, row: Tensor) -> Symbol:
    """These expressions as a tensor; `row` is the one at the example."""
    strides = row.stride()
    if value.entries.stride() != strides:
        # Laid out alike, what is a view of the one is a view of the other: what is written into it, is in both.
        value = Value(torch.empty_strided(row.shape, strides, dtype=torch.int64).copy_(value.entries), value.dtype)
    made: Symbol = Tensor._make_wrapper_subclass(Symbol, row.shape, strides=strides, dtype=row.dtype)
    made.value, made.row = value, row
    return made


def at_example(item: Any) -> Any:
    """Symbols replaced by their tensors at the example."""
    if isinstance(item, Symbol):
        return item.row
    if isinstance(item, (list, tuple)):
        return [at_example(i) for i in item]
    if isinstance(item, dict):
        return {key: at_example(i) for key, i in item.items()}
    return item
