"""Bounds on vectors: entry by entry, or a row as a whole, which keeps its direction."""

from __future__ import annotations

import torch
from torch import Tensor

from apcc_torch.settings import Setting, aligned


def within(x: Tensor, bound: Setting | None) -> Tensor:
    """x (..., n), every entry held to a magnitude of at most `bound`, a number or (...); None for no bound."""
    if bound is None:
        return x
    if isinstance(bound, Tensor):
        limit = aligned(bound, 1)
        return torch.minimum(torch.maximum(x, -limit), limit)
    return x.clamp(-bound, bound)


def scaled_within(x: Tensor, bound: Setting | None) -> Tensor:
    """x (..., n), a row scaled whole where an entry's magnitude is over `bound`, a number or (...); None for no bound.

    The bound is positive; a row within it is divided by one, and stays what it is to the last bit.
    """
    if bound is None:
        return x
    return x / (x.abs().amax(-1, keepdim=True) / aligned(bound, 1)).clamp(min=1.0)
