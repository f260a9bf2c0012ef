"""Rows of numbers in a setting, such as an offset for every sensor."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from apcc_torch.errors import ConfigError

Table = Sequence[Sequence[float]]
"""Rows of numbers."""


def table(name: str, value: Table | None, rows: int, columns: int) -> Tensor:
    """Rows of numbers as a tensor (rows, columns), float64; zeros for None.

    Args:
        name: The setting's name, for messages.
        value: The rows.
        rows: How many there must be.
        columns: How many numbers each must have.

    Raises:
        ConfigError: They are not so many finite numbers.
    """
    if value is None:
        return torch.zeros(rows, columns, dtype=torch.float64)
    try:
        numbers = torch.tensor([[float(entry) for entry in row] for row in value], dtype=torch.float64)
    except (TypeError, ValueError):
        numbers = torch.empty(0)
    if numbers.shape != (rows, columns) or not bool(numbers.isfinite().all()):
        raise ConfigError(f"{name} must be {rows} rows of {columns} numbers, got {value!r}")
    return numbers
