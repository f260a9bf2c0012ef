"""Pose sensors as they are: noise, delay and dropout, with the randomness passed in."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor, nn

from apcc_torch.errors import ValueRangeError
from apcc_torch.lie import se3
from apcc_torch.settings import Setting, aligned, check_setting, hold, is_used
from apcc_torch.shapes import check_tensor


class SensorState(NamedTuple):
    """Poses on their way: (delay + 1, ..., k, 4, 4), the newest first."""

    queue: Tensor


class PoseSensors(nn.Module):
    """Turns true poses into measured ones.

    Args:
        position_noise: Standard deviation of each coordinate, m, a number or (...) one a row.
        angular_noise: Standard deviation of each component of the rotation vector, rad, likewise.
        delay: Readings by which a measurement is late.
        dropout: Chance that a sensor is missing in a reading, independent for each, a number or (...).
        shared: Number of leading dimensions over which the draws are the same, as in runs of one seed side by side.

    Raises:
        ValueRangeError: A setting is out of range.
    """

    position_noise: Setting
    angular_noise: Setting
    dropout: Setting

    def __init__(
        self,
        position_noise: Setting = 0.0,
        angular_noise: Setting = 0.0,
        delay: int = 0,
        dropout: Setting = 0.0,
        shared: int = 0,
    ) -> None:
        super().__init__()
        for name, value in {"position_noise": position_noise, "angular_noise": angular_noise}.items():
            check_setting(name, value, zero=True)
        if delay < 0:
            raise ValueRangeError(f"delay must be zero or more readings, got {delay}")
        for chance in dropout.flatten().tolist() if isinstance(dropout, Tensor) else (dropout,):
            if not 0 <= chance < 1:
                raise ValueRangeError(f"dropout must be in [0, 1), got {chance}")
        hold(self, position_noise=position_noise, angular_noise=angular_noise, dropout=dropout)
        self.delay = delay
        self.shared = shared
        self._noisy, self._drops = is_used(position_noise) or is_used(angular_noise), is_used(dropout)

    def initial_state(self, T: Tensor) -> SensorState:
        """State of a sensor that has long seen poses T (..., k, 4, 4)."""
        return SensorState(check_tensor("T", T, (None, 4, 4)).expand(self.delay + 1, *T.shape))

    def forward(
        self, state: SensorState, T: Tensor, generator: torch.Generator | None = None
    ) -> tuple[SensorState, Tensor, Tensor]:
        """One reading.

        Args:
            state: From `initial_state` or the last reading.
            T: (..., k, 4, 4) true poses now.
            generator: Source of the noise; None for torch's global one.

        Returns:
            Next state, measured poses (..., k, 4, 4), and mask (..., k) bool, False where a sensor dropped out.
        """
        check_tensor("T", T, (None, 4, 4))
        queue = torch.cat((T.unsqueeze(0), state.queue[:-1]))
        seen = queue[-1]
        drawn = T.shape[self.shared : -2]
        if self._noisy:
            noise = torch.randn(*drawn, 6, dtype=T.dtype, device=T.device, generator=generator)
            angle = noise[..., :3] * aligned(self.angular_noise, 2)
            turn = se3.exp(torch.cat((angle, torch.zeros_like(angle)), dim=-1))
            shift = se3.pose(seen[..., :3, :3], seen[..., :3, 3] + aligned(self.position_noise, 2) * noise[..., 3:])
            seen = shift @ turn
        mask = torch.ones(T.shape[:-2], dtype=torch.bool, device=T.device)
        if self._drops:
            draws = torch.rand(drawn, dtype=T.dtype, device=T.device, generator=generator)
            mask = (draws >= aligned(self.dropout, 1)).expand(T.shape[:-2])
        return SensorState(queue), seen, mask
