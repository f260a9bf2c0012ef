"""Curvature as gratings along an arm measure it: with noise, and an offset that stays."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, NamedTuple

import torch
from torch import Tensor

from apcc_torch.part import Part
from apcc_torch.settings import OURS, Setting, Settings, aligned, is_on, resolved, setting


class CurvatureState(NamedTuple):
    """Curvature on its way (..., delay + 1, n_c, 2), the newest first, and each place's offset (..., n_c, 2), 1/m."""

    queue: Tensor
    offset: Tensor


@dataclass(frozen=True, kw_only=True)
class CurvatureSensorsSettings(Settings):
    """Settings of `CurvatureSensors`: standard deviations."""

    noise: Setting = setting(0.0, "1/m", OURS, "of each component of a reading", rows="number", least=0, apart=True)
    offset: Setting = setting(
        0.0, "1/m", OURS, "of each component of a place's offset, drawn once", rows="number", least=0, apart=True
    )


class CurvatureSensors(Part):
    """Turns an arm's true curvature at places along it into a measured one.

    Args:
        *settings, **changes: See `CurvatureSensorsSettings`; numbers may be tensors (...), one a row.

    Raises:
        ValueRangeError: A setting is out of range.

    Example:
        >>> gratings, true = CurvatureSensors(noise=0.1), torch.tensor([[2.0, 0.0]])
        >>> state = gratings.initial_state(true, delay=1)
        >>> state, seen = gratings(state, true + 1.0, torch.zeros(1, 2))
        >>> seen
        tensor([[2., 0.]])
    """

    settings_type = CurvatureSensorsSettings
    noise: Setting
    offset: Setting

    def __init__(self, *settings: Any, **changes: Any) -> None:
        super().__init__()
        self.hold(resolved(CurvatureSensorsSettings, settings, changes))

    @property
    def noisy(self) -> bool:
        """Whether a reading depends on chance."""
        return is_on(self.noise)

    def initial_state(
        self, curvature: Tensor, delay: int = 0, generator: torch.Generator | None = None, shared: int = 0
    ) -> CurvatureState:
        """State of sensors that have long seen a curvature (..., n_c, 2), 1/m.

        Args:
            curvature: What they see.
            delay: Readings by which one is late.
            generator: Where chance comes from; None for torch's global one.
            shared: Number of leading dimensions over which it is the same.
        """
        offset = torch.zeros_like(curvature)
        if is_on(self.offset):
            drawn = torch.randn(
                curvature.shape[shared:], dtype=curvature.dtype, device=curvature.device, generator=generator
            )
            offset = offset + drawn * aligned(self.offset, 2)
        queue = curvature.unsqueeze(-3).expand(*curvature.shape[:-2], delay + 1, *curvature.shape[-2:])
        return CurvatureState(queue, offset)

    def forward(self, state: CurvatureState, curvature: Tensor, draws: Tensor | None) -> tuple[CurvatureState, Tensor]:
        """The next state, and a reading (..., n_c, 2), 1/m.

        Args:
            state: From `initial_state` or the last reading.
            curvature: (..., n_c, 2) true one now.
            draws: (..., n_c, 2) standard normal; None where nothing is `noisy`.
        """
        queue = torch.cat((curvature.unsqueeze(-3), state.queue[..., :-1, :, :]), dim=-3)
        seen = queue[..., -1, :, :] + state.offset
        if draws is not None:
            seen = seen + draws * aligned(self.noise, 2)
        return CurvatureState(queue, state.offset), seen
