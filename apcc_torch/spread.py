"""Numbers along the arm: one for all its sections, one a section, or a profile that serves arms of any number."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor, nn

from apcc_torch.errors import ConfigError

Numbers = float | Sequence[float | str] | Tensor
"""A number for all entries, one an entry, a profile `["along", ...]`, see `spread`, or a tensor (..., n)."""

ALONG = "along"
"""The first entry of a list that is a profile: what follows are values from the base to the tip, however many."""


def spread(name: str, value: Numbers, n: int) -> Tensor:
    """One number an entry, (..., n), float64 unless a tensor says otherwise.

    Args:
        name: The setting's name, for messages.
        value: A number for all; n numbers; a tensor (..., n); or a profile `["along", ...]`, numbers from the base to
            the tip that are read off at each entry's place: it serves arms of any n.
        n: Number of entries.

    Raises:
        ConfigError: It is none of these.
    """
    if isinstance(value, Tensor):
        if value.dim() and value.shape[-1] != n:
            raise ConfigError(f"{name} must have {n} entries, got {value.shape[-1]}")
        if isinstance(value, nn.Parameter) and not value.dim():
            raise ConfigError(f"{name} is trained as {n} numbers: hand in nn.Parameter(torch.full(({n},), number))")
        return value if value.dim() else value.expand(n)
    if isinstance(value, int | float) and not isinstance(value, bool):
        return torch.full((n,), float(value), dtype=torch.float64)
    if is_profile(value) and len(value) > 1:  # type: ignore[arg-type]
        points = _vector(name, value[1:], n)  # type: ignore[index]
        return points if len(points) == n else _resampled(points, n)
    numbers = _vector(name, value, n)
    if len(numbers) != n:
        raise ConfigError(f"{name} must have {n} entries, got {len(numbers)}")
    return numbers


def is_profile(value: Any) -> bool:
    """Whether it is a list of values along the arm."""
    return isinstance(value, list | tuple) and len(value) > 0 and value[0] == ALONG


def _vector(name: str, value: Any, n: int) -> Tensor:
    try:
        if isinstance(value, str | bool) or any(isinstance(entry, str | bool) for entry in value):
            raise TypeError
        return torch.tensor([float(entry) for entry in value], dtype=torch.float64)
    except (TypeError, ValueError) as error:
        raise ConfigError(f"{name} must be a number, a list of {n} numbers or [along, ...], got {value!r}") from error


def _resampled(points: Tensor, n: int) -> Tensor:
    """A profile (m,) at the middles of n equal shares of the arm, between the middles of m, constant beyond them."""
    m = len(points)
    at = ((torch.arange(n, dtype=points.dtype) + 0.5) * (m / n) - 0.5).clamp(0.0, m - 1.0)
    low = at.floor().to(torch.int64).clamp(max=max(m - 2, 0))
    return torch.lerp(points[low], points[(low + 1).clamp(max=m - 1)], at - low)
