"""Modes of torch that a step may run under: traced, vectorised, without values, in mixed precision."""

from __future__ import annotations

from collections.abc import Callable
from functools import wraps
from typing import Any, ParamSpec, TypeVar

import torch
from torch import Tensor

P = ParamSpec("P")
R = TypeVar("R")


def values_of(tensor: Tensor) -> Any:
    """A tensor's value, nested lists of them, or None where it has none to read: the one guard of all that reads some.

    There is none on the meta device, under `vmap`, and in what is compiled, exported or traced, where whatever branches
    on one goes the way that is right for all.
    """
    tracing = torch.compiler.is_compiling() or torch.jit.is_tracing()  # type: ignore[attr-defined]
    if tracing or tensor.is_meta:
        return None
    try:
        return tensor.tolist() if tensor.dim() else tensor.item()
    except RuntimeError:  # a vectorised, a fake and a tracing tensor say so by raising this
        return None


def known(condition: Tensor) -> bool:
    """Whether `condition` holds everywhere, as far as it may be asked: what a shortcut past unused branches needs.

    False on an accelerator too, where the answer costs more than the shortcut saves: it would wait for the queue. A
    shortcut gives the same bits as the long way.
    """
    return condition.is_cpu and values_of(condition.all()) is True


def none_left(rows: Tensor) -> bool:
    """Whether no row is left to work on, as far as it may be asked; else the work goes on with all of them frozen."""
    return values_of(rows.any()) is False


def holds(condition: Tensor) -> bool:
    """Whether a condition on an argument holds everywhere; of what has no values to read it is taken to hold."""
    return values_of(condition.all()) in (True, None)


def full_precision(function: Callable[P, R]) -> Callable[P, R]:
    """The function without `torch.autocast`: a matrix product of lengths and angles keeps the digits of its arguments.

    Every public method of a `Part` is decorated with it, and of the functions that are used by themselves those that
    multiply matrices.
    """

    @wraps(function)
    def exact(*args: P.args, **keywords: P.kwargs) -> R:
        if not torch._C._is_any_autocast_enabled():
            return function(*args, **keywords)
        with torch.autocast("cpu", enabled=False), torch.autocast("cuda", enabled=False):
            return function(*args, **keywords)

    # A code of its own: `torch.compile` keeps what it has compiled with the code, so much and no more of each.
    name, qualname = function.__name__, function.__qualname__
    exact.__code__ = exact.__code__.replace(co_name=name, co_qualname=qualname)  # type: ignore[attr-defined]
    return exact
