"""Places along an arm in a setting: in order, and on the arm."""

from __future__ import annotations

import torch
from torch import Tensor

from apcc_torch.errors import ValueRangeError
from apcc_torch.modes import holds


def check_places(name: str, value: tuple[float, ...] | Tensor | None, end: Tensor) -> None:
    """Raises ValueRangeError where abscissae do not increase, are none, or lie beyond the arm's end.

    Args:
        name: The setting's name, for messages.
        value: (..., k) m; None: there is nothing to check.
        end: (..., 1) length of the arm, m.
    """
    if value is None:
        return
    at = value if isinstance(value, Tensor) else torch.tensor(value, dtype=torch.float64)
    if not at.shape[-1] or not holds(at.diff(dim=-1) > 0):
        raise ValueRangeError(f"{name} must be increasing, at least one, got {at.tolist()}")
    if not holds(at <= end):
        raise ValueRangeError(f"{name} must lie on the arm, {float(end.max()):.4g} m long, got {at.tolist()}")
