"""What differs from episode to episode: ranges given once, numbers drawn for every row when it resets."""

from __future__ import annotations

from dataclasses import dataclass, fields
from typing import NamedTuple

import torch
from torch import Tensor

from apcc_torch.envs.streams import Stream
from apcc_torch.errors import ValueRangeError
from apcc_torch.settings import OURS, Settings, setting

Range = tuple[float, float]
"""(low, high), both included; equal where nothing varies."""


def check_range(name: str, value: Range) -> None:
    """Raises ValueRangeError where `value` is not two increasing numbers."""
    if not isinstance(value, tuple) or len(value) != 2 or not value[0] <= value[1]:
        raise ValueRangeError(f"{name} must be a range (low, high) with low <= high, got {value!r}")


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


@dataclass(frozen=True, kw_only=True)
class Ranges(Settings):
    """Ranges (low, high) of `RowParameters`, uniform between them.

    Raises:
        ValueRangeError: A range is not two increasing numbers, or leaves what makes sense for its quantity.
    """

    lengths: Range = setting((1.0, 1.0), "", OURS, "each section's true rest length over the nominal one", least=0.1)
    stiffness: Range = setting(
        (1.0, 1.0), "", OURS, "true stiffness over the nominal one; dynamic arms only", least=0.1
    )
    payload: Range = setting((0.0, 0.5), "kg", OURS, "mass at the tip; dynamic arms only", least=0)
    noise: Range = setting((0.0, 0.0), "m", OURS, "standard deviation of the sensors' coordinates", least=0)
    delay: tuple[int, int] = setting(
        (0, 0), "", OURS, "control periods by which the sensors are late, whole ones", least=0
    )
    estimate: Range = setting(
        (0.85, 1.15), "", OURS, "the controller's first rest lengths over the true ones; adaptation only", least=0.1
    )

    def check(self) -> None:
        """Raises ValueRangeError where a range is none."""
        super().check()
        for each in fields(Ranges):
            check_range(each.name, getattr(self, each.name))

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
