"""Pose sensors as they are: noise, delay and dropout, with the randomness passed in."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from apcc_torch.errors import ValueRangeError
from apcc_torch.lie import se3
from apcc_torch.part import Part, check_settings_or_zero, hold
from apcc_torch.settings import Setting, aligned, is_used
from apcc_torch.shapes import check_tensor


class SensorState(NamedTuple):
    """Poses on their way: (..., delay + 1, k, 4, 4), the newest first."""

    queue: Tensor


class Draws(NamedTuple):
    """The chance in a reading: standard normal noise (..., k, 6), uniform chances (..., k); None where not used."""

    noise: Tensor | None
    chance: Tensor | None


class PoseSensors(Part):
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
        check_settings_or_zero(position_noise=position_noise, angular_noise=angular_noise)
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
        check_tensor("T", T, (None, 4, 4))
        return SensorState(T.unsqueeze(-4).expand(*T.shape[:-3], self.delay + 1, *T.shape[-3:]))

    def draw(self, T: Tensor, generator: torch.Generator | None = None) -> Draws:
        """The chance in one reading of poses with the shape of T (..., k, 4, 4).

        Args:
            T: Read for its shape and type alone.
            generator: Where it comes from; None for torch's global one.
        """
        drawn = T.shape[self.shared : -2]
        noise = chance = None
        if self._noisy:
            noise = torch.randn(*drawn, 6, dtype=T.dtype, device=T.device, generator=generator)
        if self._drops:
            chance = torch.rand(drawn, dtype=T.dtype, device=T.device, generator=generator)
        return Draws(noise, chance)

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
        return self.read(state, T, self.draw(T, generator))

    def read(self, state: SensorState, T: Tensor, draws: Draws) -> tuple[SensorState, Tensor, Tensor]:
        """`forward` with its chance drawn before, by `draw`."""
        check_tensor("T", T, (None, 4, 4))
        queue = torch.cat((T.unsqueeze(-4), state.queue[..., :-1, :, :, :]), dim=-4)
        seen = queue[..., -1, :, :, :]
        if draws.noise is not None:
            angle = draws.noise[..., :3] * aligned(self.angular_noise, 2)
            turn = se3.exp(torch.cat((angle, torch.zeros_like(angle)), dim=-1))
            place = seen[..., :3, 3] + aligned(self.position_noise, 2) * draws.noise[..., 3:]
            seen = se3.pose(seen[..., :3, :3], place) @ turn
        mask = torch.ones(T.shape[:-2], dtype=torch.bool, device=T.device)
        if draws.chance is not None:
            mask = (draws.chance >= aligned(self.dropout, 1)).expand(T.shape[:-2])
        return SensorState(queue), seen, mask
