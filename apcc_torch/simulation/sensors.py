"""Sensors as they are: noise, delay and dropout, with the randomness passed in."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, NamedTuple

import torch
from torch import Tensor

from apcc_torch.lie import se3
from apcc_torch.part import Part
from apcc_torch.settings import MANY, OURS, Setting, Settings, aligned, is_on, resolved, setting
from apcc_torch.shapes import check_tensor


class SensorState(NamedTuple):
    """Poses on their way: (..., delay + 1, k, 4, 4), the newest first."""

    queue: Tensor


class Draws(NamedTuple):
    """The chance in a reading; None where not used.

    noise: (..., k, 6) standard normal, of the poses. chance: (..., k) uniform. tendons: (..., n_a) standard normal.
    """

    noise: Tensor | None
    chance: Tensor | None
    tendons: Tensor | None = None


@dataclass(frozen=True, kw_only=True)
class PoseSensorsSettings(Settings):
    """Settings of `PoseSensors`."""

    position_noise: Setting = setting(
        0.0, "m", OURS, "standard deviation of each coordinate", rows="number", least=0, apart=True
    )
    angular_noise: Setting = setting(
        0.0, "rad", OURS, "standard deviation of each rotation-vector component", rows="number", least=0, apart=True
    )
    delay: int = setting(0, "", OURS, "control periods by which a reading is late", least=0, most=MANY)
    dropout: Setting = setting(
        0.0, "", OURS, "chance that a sensor is missing in a reading", rows="number", least=0, below=1, apart=True
    )
    tendon_noise: Setting = setting(
        0.0, "m", OURS, "standard deviation of each tendon's measured length", rows="number", least=0, apart=True
    )
    tendon_stretch: Setting = setting(
        0.0,
        "m/N",
        OURS,
        "of each tendon between its motor, which measures it, and the arm",
        rows="number",
        least=0,
        apart=True,
    )


class PoseSensors(Part):
    """Turns true poses into measured ones, and the tendons' true lengths into those that their motors measure.

    Args:
        *settings, **changes: See `PoseSensorsSettings`; numbers but the delay may be tensors (...), one a row.
        shared: Number of leading dimensions over which the draws are the same, as in runs of one seed side by side.

    Raises:
        ValueRangeError: A setting is out of range.

    Example:
        >>> sensors = PoseSensors(position_noise=2e-4)
        >>> T = torch.eye(4).repeat(3, 1, 1)
        >>> state, seen, mask = sensors(sensors.initial_state(T), T, torch.Generator().manual_seed(0))
        >>> seen.shape, mask.tolist()
        (torch.Size([3, 4, 4]), [True, True, True])
    """

    settings_type = PoseSensorsSettings
    position_noise: Setting
    angular_noise: Setting
    delay: int
    dropout: Setting
    tendon_noise: Setting
    tendon_stretch: Setting

    def __init__(self, *settings: Any, shared: int = 0, **changes: Any) -> None:
        super().__init__()
        self.shared = shared
        self.hold(resolved(PoseSensorsSettings, settings, changes))

    @property
    def noisy(self) -> bool:
        """Whether anything is added to a reading."""
        return is_on(self.position_noise) or is_on(self.angular_noise)

    def initial_state(self, T: Tensor) -> SensorState:
        """State of a sensor that has long seen poses T (..., k, 4, 4)."""
        check_tensor("T", T, (None, 4, 4))
        return SensorState(T.unsqueeze(-4).expand(*T.shape[:-3], self.delay + 1, *T.shape[-3:]))

    def draw(self, T: Tensor, generator: torch.Generator | None = None, n_tendons: int = 0) -> Draws:
        """The chance in one reading of poses with the shape of T (..., k, 4, 4).

        Args:
            T: Read for its shape and type alone.
            generator: Where it comes from; None for torch's global one.
            n_tendons: Tendons that are measured too.
        """
        drawn = T.shape[self.shared : -2]
        noise = chance = tendons = None
        if self.noisy:
            noise = torch.randn(*drawn, 6, dtype=T.dtype, device=T.device, generator=generator)
        if is_on(self.dropout):
            chance = torch.rand(drawn, dtype=T.dtype, device=T.device, generator=generator)
        if n_tendons and is_on(self.tendon_noise):
            tendons = torch.randn(*drawn[:-1], n_tendons, dtype=T.dtype, device=T.device, generator=generator)
        return Draws(noise, chance, tendons)

    @property
    def stretches(self) -> bool:
        """Whether what a motor measures depends on its tendon's force."""
        return is_on(self.tendon_stretch)

    def measured_tendons(self, y: Tensor, u: Tensor | None, draws: Draws) -> Tensor:
        """Length changes (..., n_a) m as the motors measure them: a tendon that is pulled is longer than they say.

        Args:
            y: (..., n_a) true ones along the arm, m.
            u: (..., n_a) the tendons' forces, N, tension is -u; None where nothing `stretches`.
            draws: From `draw`.
        """
        if self.stretches and u is not None:
            y = y + aligned(self.tendon_stretch, 1) * u
        return y if draws.tendons is None else y + aligned(self.tendon_noise, 1) * draws.tendons

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
