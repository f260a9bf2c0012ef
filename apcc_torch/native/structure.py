"""Arguments and results as flat lists of tensors: nested tuples and named tuples, and None where nothing is."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any

import torch
from torch import Tensor

from apcc_torch.errors import CompileError


def flattened(item: Any) -> list[Tensor]:
    """The tensors of nested tuples, in order.

    Raises:
        CompileError: There is something else than tensors, tuples and None.
    """
    result: list[Tensor] = []
    _flatten(item, result)
    return result


def _flatten(item: Any, result: list[Tensor]) -> None:
    if isinstance(item, Tensor):
        result.append(item)
    elif isinstance(item, tuple):
        for part in item:
            _flatten(part, result)
    elif item is not None:
        raise CompileError(f"a compiled function takes and returns tensors in tuples, not a {type(item).__name__}")


def rebuilt(like: Any, leaves: Iterator[Any]) -> Any:
    """`like` with its tensors replaced in order."""
    if isinstance(like, Tensor):
        return next(leaves)
    if like is None:
        return None
    parts = [rebuilt(part, leaves) for part in like]
    return type(like)(*parts) if hasattr(like, "_fields") else tuple(parts)


def mapped(function: Callable[..., Any], *items: Any) -> Any:
    """Nested tuples of one form with `function` of their leaves in place of these."""
    if items[0] is None:
        return None
    if not isinstance(items[0], tuple):
        return function(*items)
    parts = [mapped(function, *each) for each in zip(*items, strict=True)]
    return type(items[0])(*parts) if hasattr(items[0], "_fields") else tuple(parts)


def described(item: Any) -> str:
    """Types, shapes and names of everything in it, as text."""
    if isinstance(item, Tensor):
        return f"{item.dtype}{tuple(item.shape)}"
    if item is None:
        return "None"
    return f"{type(item).__qualname__}({', '.join(described(part) for part in item)})"


def any_double(tensors: list[Tensor]) -> bool:
    """Whether one of them is of double precision."""
    return any(t.dtype == torch.float64 for t in tensors)
