"""What differs from episode to episode: ranges given once, numbers drawn for every row when it resets."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields
from typing import NamedTuple

import torch
from torch import Tensor

from apcc_torch.envs.streams import Stream
from apcc_torch.errors import ValueRangeError

Range = Sequence[float]
"""(low, high), both included; equal where nothing varies."""


class RowParameters(NamedTuple):
    """What was drawn for each of N rows.

    lengths: (N, n_b) true rest lengths over the nominal ones, one factor a section of the model.
    stiffness: (N,) true stiffness over the nominal one.
    payload: (N,) kg at the tip.
    noise: (N,) m, standard deviation of each coordinate of a sensor's position.
    delay: (N,) int64 control periods by which a reading is late.
    estimate: (N, n_b) the controller's first estimate of the rest lengths over the true ones.
    """

    lengths: Tensor
    stiffness: Tensor
    payload: Tensor
    noise: Tensor
    delay: Tensor
    estimate: Tensor


@dataclass(frozen=True)
class Ranges:
    """Ranges (low, high) of `RowParameters`, uniform between them.

    Raises:
        ValueRangeError: A range is not two increasing numbers, or leaves what makes sense for its quantity.
    """

    lengths: Range = (1.0, 1.0)
    stiffness: Range = (1.0, 1.0)
    payload: Range = (0.0, 0.5)
    noise: Range = (0.0, 0.0)
    delay: Range = (0, 0)
    estimate: Range = (0.85, 1.15)

    def __post_init__(self) -> None:
        """Checks every range."""
        for field in fields(self):
            name, given = field.name, getattr(self, field.name)
            least = 0.1 if name in ("lengths", "stiffness", "estimate") else 0.0
            if not isinstance(given, Sequence) or len(given) != 2:
                raise ValueRangeError(f"{name} must be a range (low, high), got {given!r}")
            if not least <= given[0] <= given[1] < float("inf"):
                raise ValueRangeError(f"{name} must be a range with {least:g} <= low <= high, got {tuple(given)}")
        if any(int(end) != end for end in self.delay):
            raise ValueRangeError(f"delay must be a range of whole control periods, got {tuple(self.delay)}")

    def varies(self, name: str) -> bool:
        """Whether the quantity differs from its nominal value 1 in any row."""
        return tuple(getattr(self, name)) != (1.0, 1.0)

    def draw(self, stream: Stream, n_sections: int, dtype: torch.dtype) -> tuple[Stream, RowParameters]:
        """The streams after the draws, and every row's numbers."""
        stream, u = stream.uniform(2 * n_sections + 4, dtype)

        def within(bounds: Range, draws: Tensor) -> Tensor:
            low, high = bounds
            return low + (high - low) * draws

        first, last = int(self.delay[0]), int(self.delay[1])
        late = (first + u[:, 3] * (last - first + 1)).floor().clamp(max=last).to(torch.int64)
        rows = RowParameters(
            within(self.lengths, u[:, 4 : 4 + n_sections]),
            within(self.stiffness, u[:, 0]),
            within(self.payload, u[:, 1]),
            within(self.noise, u[:, 2]),
            late,
            within(self.estimate, u[:, 4 + n_sections :]),
        )
        return stream, rows
