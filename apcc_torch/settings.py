"""Settings of a module: each a number, or a tensor with a number for every row of a batch."""

from __future__ import annotations

from typing import TypeVar

from torch import Tensor, nn

from apcc_torch.errors import ValueRangeError

Setting = float | Tensor
"""A number for all rows, or (...) numbers that broadcast with the leading dimensions of what they are used on."""

Given = TypeVar("Given", float, Tensor, Setting)


def check_setting(name: str, value: Given, zero: bool = False) -> Given:
    """Returns `value` if it, or every number in it, is finite and positive.

    This reads values, so it belongs at construction.

    Args:
        name: The argument's name, as the caller wrote it.
        value: The setting.
        zero: Whether zero is allowed too.

    Raises:
        ValueRangeError: "damping must be positive and finite, got -1.0".
    """
    for number in value.detach().flatten().tolist() if isinstance(value, Tensor) else (value,):
        if not (number >= 0 if zero else number > 0) or number == float("inf"):
            raise ValueRangeError(f"{name} must be {'zero or ' if zero else ''}positive and finite, got {number}")
    return value


def check_settings(**settings: Setting | None) -> None:
    """`check_setting` of each, by its name; None, of a setting that may be left out, passes."""
    for name, value in settings.items():
        if value is not None:
            check_setting(name, value)


def check_settings_or_zero(**settings: Setting) -> None:
    """`check_setting` of each, by its name; zero passes."""
    for name, value in settings.items():
        check_setting(name, value, zero=True)


def hold(module: nn.Module, **settings: Setting | None) -> None:
    """Makes settings attributes of a module; tensors become buffers, so that they move with it."""
    for name, value in settings.items():
        if isinstance(value, Tensor):
            hold_rows(module, **{name: (value, 0)})
        else:
            setattr(module, name, value)


def hold_rows(module: nn.Module, **tensors: tuple[Tensor | None, int]) -> None:
    """Makes tensors buffers of a module that may differ from row to row: name = (tensor, its trailing dimensions)."""
    # Beside the buffers: which of them may have leading dimensions, with the number of the others.
    trailing = module.__dict__.setdefault("trailing_dimensions", {})
    for name, (value, dimensions) in tensors.items():
        module.register_buffer(name, value)
        trailing[name] = dimensions


def row_tensors(module: nn.Module) -> dict[str, tuple[Tensor, int]]:
    """Of a module and all it holds, the buffers that differ by row: dotted name, tensor, trailing dimensions."""
    found = {}
    for prefix, part in module.named_modules():
        for name, trailing in part.__dict__.get("trailing_dimensions", {}).items():
            tensor = getattr(part, name)
            if tensor is not None and tensor.dim() > trailing:
                found[f"{prefix}.{name}" if prefix else name] = (tensor, trailing)
    return found


def aligned(value: Given, extra: int) -> Given:
    """The setting for use on tensors with `extra` dimensions behind the batch's: (...) becomes (..., 1, ...)."""
    return value[(..., *(None,) * extra)] if isinstance(value, Tensor) else value


def is_used(value: Setting) -> bool:
    """Whether a setting that zero turns off is on for any row; reads values, so for construction only."""
    return bool((value > 0).any()) if isinstance(value, Tensor) else value > 0
