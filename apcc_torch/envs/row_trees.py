"""States as trees of rows: every tensor's first dimension is the environment."""

from __future__ import annotations

from collections.abc import Callable
from typing import TypeVar

import torch
from torch import Tensor

Tree = TypeVar("Tree")


def map_rows(change: Callable[..., Tensor], tree: Tree, *others: Tree) -> Tree:
    """The tree of the same form with every tensor changed; None stays None.

    Args:
        change: (tensor of the tree, tensors of the others) -> tensor.
        tree: A tensor, None, or a tuple of trees, named or not.
        *others: Trees of the same form.
    """
    if tree is None:
        return tree
    if isinstance(tree, Tensor):
        return change(tree, *others)  # type: ignore[return-value]
    branches = [map_rows(change, *branch) for branch in zip(tree, *others, strict=True)]  # type: ignore[call-overload]
    return type(tree)(*branches) if hasattr(tree, "_fields") else type(tree)(branches)  # type: ignore[call-arg]


def select(mask: Tensor, chosen: Tree, other: Tree) -> Tree:
    """Rows of `chosen` where mask (N,), of `other` elsewhere."""
    return map_rows(lambda a, b: torch.where(mask.view(-1, *[1] * (a.dim() - 1)), a, b), chosen, other)


def replaced(tree: Tree, index: Tensor, rows: Tree) -> Tree:
    """The tree with its rows `index` (k,) taken from `rows`, k of them."""
    return map_rows(lambda whole, part: whole.index_copy(0, index, part), tree, rows)


def taken(tree: Tree, index: Tensor) -> Tree:
    """The rows `index` (k,) of the tree."""
    return map_rows(lambda whole: whole.index_select(0, index), tree)
