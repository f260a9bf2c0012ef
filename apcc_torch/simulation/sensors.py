"""Pose sensors as they are: noise, delay and dropout, with the randomness passed in."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor, nn

from apcc_torch.errors import ValueRangeError
from apcc_torch.lie import se3
from apcc_torch.shapes import check_tensor


class SensorState(NamedTuple):
    """Poses on their way: (delay + 1, ..., k, 4, 4), the newest first."""

    queue: Tensor


class PoseSensors(nn.Module):
    """Turns true poses into measured ones.

    Args:
        position_noise: Standard deviation of each coordinate, m.
        angular_noise: Standard deviation of each component of the rotation vector, rad.
        delay: Readings by which a measurement is late.
        dropout: Chance that a sensor is missing in a reading, independent for each.

    Raises:
        ValueRangeError: A setting is out of range.
    """

    def __init__(
        self, position_noise: float = 0.0, angular_noise: float = 0.0, delay: int = 0, dropout: float = 0.0
    ) -> None:
        super().__init__()
        for name, value in {"position_noise": position_noise, "angular_noise": angular_noise}.items():
            if not 0 <= value < float("inf"):
                raise ValueRangeError(f"{name} must be zero or positive and finite, got {value}")
        if delay < 0:
            raise ValueRangeError(f"delay must be zero or more readings, got {delay}")
        if not 0 <= dropout < 1:
            raise ValueRangeError(f"dropout must be in [0, 1), got {dropout}")
        self.position_noise = position_noise
        self.angular_noise = angular_noise
        self.delay = delay
        self.dropout = dropout

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
        if self.position_noise > 0 or self.angular_noise > 0:
            noise = torch.randn(*T.shape[:-2], 6, dtype=T.dtype, device=T.device, generator=generator)
            turn = se3.exp(torch.cat((noise[..., :3] * self.angular_noise, torch.zeros_like(noise[..., 3:])), dim=-1))
            shift = se3.pose(seen[..., :3, :3], seen[..., :3, 3] + self.position_noise * noise[..., 3:])
            seen = shift @ turn
        mask = torch.ones(T.shape[:-2], dtype=torch.bool, device=T.device)
        if self.dropout > 0:
            mask = torch.rand(T.shape[:-2], dtype=T.dtype, device=T.device, generator=generator) >= self.dropout
        return SensorState(queue), seen, mask
