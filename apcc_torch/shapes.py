"""The one shape, dtype and value check, with the one message form, for every public operation."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from apcc_torch.errors import DtypeError, ShapeError, ValueRangeError
from apcc_torch.modes import holds

FINEST_STAMP = 1e-3
"""Stamps must be told apart by this much, s."""

Trailing = tuple[int | None, ...]


def _spelled(trailing: Trailing) -> str:
    inner = ", ".join("*" if n is None else str(n) for n in trailing)
    return f"(..., {inner})" if trailing else "(...)"


def check_tensor(name: str, value: Tensor, trailing: Trailing) -> Tensor:
    """Returns `value` if it is a floating tensor whose trailing dimensions match.

    Args:
        name: The argument's name, as the caller wrote it.
        value: The tensor to check.
        trailing: Required trailing sizes; None matches any size.

    Raises:
        DtypeError: `value` is not a floating-point tensor.
        ShapeError: The trailing dimensions differ: "q must have shape (..., 9), got (4, 8)".
    """
    if not isinstance(value, Tensor):
        raise DtypeError(f"{name} must be a torch tensor, got {type(value).__name__}")
    if not value.is_floating_point():
        raise DtypeError(f"{name} must be a floating-point tensor, got {value.dtype}")
    shape = tuple(value.shape)
    first = len(shape) - len(trailing)
    # A plain loop: this check runs many times in every control step.
    matches = first >= 0
    for i, want in enumerate(trailing):
        if not matches:
            break
        matches = want is None or want == shape[first + i]
    if not matches:
        raise ShapeError(f"{name} must have shape {_spelled(trailing)}, got {shape}")
    return value


def check_same(**tensors: Tensor) -> None:
    """Checks that all tensors share one dtype and one device.

    Raises:
        DtypeError: Two of them differ: "q is torch.float64 but L0 is torch.float32; give both one dtype".
    """
    names = list(tensors)
    first = tensors[names[0]]
    for other in names[1:]:
        if tensors[other].dtype != first.dtype:
            raise DtypeError(f"{names[0]} is {first.dtype} but {other} is {tensors[other].dtype}; give both one dtype")
        if tensors[other].device != first.device:
            raise DtypeError(
                f"{names[0]} is on {first.device} but {other} is on {tensors[other].device}; move both to one device"
            )


def check_finite(name: str, value: Tensor) -> Tensor:
    """Returns `value` if every entry is finite.

    This reads values, so it belongs at construction and at the edge of a program, not in hot paths. A tensor without
    values, as on the meta device, passes.

    Raises:
        ValueRangeError: An entry is NaN or infinite: "q is not finite at index (3, 1)".
    """
    finite = torch.isfinite(value)
    if not holds(finite):
        index = tuple(int(i) for i in (~finite).nonzero()[0])
        raise ValueRangeError(f"{name} is not finite at index {index}")
    return value


def check_positive(name: str, value: Tensor) -> Tensor:
    """Returns `value` if every entry is finite and strictly positive.

    Raises:
        ValueRangeError: "pi must be positive, got -0.1 at index (2,)".
    """
    check_finite(name, value)
    good = value > 0
    if not holds(good):
        index = tuple(int(i) for i in (~good).nonzero()[0])
        raise ValueRangeError(f"{name} must be positive, got {float(value[index]):g} at index {index}")
    return value


def coarse_stamps(name: str, time: Tensor) -> str | None:
    """What is wrong with stamps, s, whose dtype cannot tell milliseconds apart; None where nothing is.

    Example:
        >>> coarse_stamps("time", torch.tensor(1.7e9))
        'time is torch.float32, which has steps of 128 s at 1.7e+09 s; hand in float64, or seconds since the start'
    """
    if time.dtype is torch.float64 or holds(time.abs() * torch.finfo(time.dtype).eps <= FINEST_STAMP):
        return None
    latest = time.abs().max()
    step = float(torch.nextafter(latest, torch.full_like(latest, torch.inf)) - latest)
    return (
        f"{name} is {time.dtype}, which has steps of {step:.3g} s at {float(latest):.3g} s; "
        "hand in float64, or seconds since the start"
    )


def check_stamps(name: str, time: Tensor) -> Tensor:
    """Returns `time` (...), s, if its dtype tells milliseconds apart there.

    Raises:
        ValueRangeError: It does not; see `coarse_stamps`.
    """
    fault = coarse_stamps(name, time)
    if fault:
        raise ValueRangeError(fault)
    return time


def broadcast(*shapes: torch.Size) -> torch.Size:
    """The shape that tensors of these shapes have together.

    Of plain numbers, as numpy does it: at its first call torch's own function imports all of sympy, which takes a
    second. That one knows the sizes that `torch.compile` and `torch.export` leave open.

    Raises:
        ShapeError: They do not broadcast.

    Example:
        >>> broadcast(torch.Size([4, 1]), torch.Size([3]))
        torch.Size([4, 3])
    """
    open_sizes = torch.compiler.is_compiling() or any(type(size) is not int for shape in shapes for size in shape)
    try:
        return torch.broadcast_shapes(*shapes) if open_sizes else torch.Size(np.broadcast_shapes(*shapes))
    except (RuntimeError, ValueError) as error:
        raise ShapeError(f"shapes do not broadcast: {', '.join(str(tuple(shape)) for shape in shapes)}") from error


def batch_shape(**leading: tuple[Tensor, int]) -> torch.Size:
    """The broadcast of the tensors' leading dimensions.

    Args:
        **leading: name = (tensor, number of trailing dimensions that are not batch).

    Raises:
        ShapeError: They do not broadcast; the message names every argument and its batch shape.
    """
    shapes = {name: tensor.shape[: tensor.dim() - k] for name, (tensor, k) in leading.items()}
    first, *others = shapes.values()
    if all(shape == first for shape in others):
        return first
    try:
        return broadcast(first, *others)
    except ShapeError as error:
        listed = ", ".join(f"{name} {tuple(shape)}" for name, shape in shapes.items())
        raise ShapeError(f"leading dimensions do not broadcast: {listed}") from error
