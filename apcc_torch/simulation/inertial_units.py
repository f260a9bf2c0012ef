"""Inertial units as they are: a noisy tilt, a mounting that is a little off, and a heading that drifts."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, NamedTuple

import torch
from torch import Tensor

from apcc_torch.lie import so3
from apcc_torch.part import Part
from apcc_torch.settings import OURS, Setting, Settings, aligned, is_on, resolved, setting


class InertialState(NamedTuple):
    """What units carry along.

    mounting: (..., p, 3) turn of each unit against the arm, rad. heading: (..., p) by how much each is off now, rad.
    """

    mounting: Tensor
    heading: Tensor


@dataclass(frozen=True, kw_only=True)
class InertialUnitsSettings(Settings):
    """Settings of `InertialUnits`: standard deviations."""

    tilt_noise: Setting = setting(
        0.0, "rad", OURS, "of each rotation-vector component of a reading", rows="number", least=0, apart=True
    )
    mounting: Setting = setting(
        0.0, "rad", OURS, "of each component of how a unit sits, drawn once", rows="number", least=0, apart=True
    )
    heading: Setting = setting(
        0.0, "rad", OURS, "of a unit's heading at the start, drawn once", rows="number", least=0, apart=True
    )
    heading_drift: Setting = setting(
        0.0, "rad/sqrt(s)", OURS, "of a heading's random walk", rows="number", least=0, apart=True
    )


class InertialUnits(Part):
    """Turns true orientations of units into measured ones, R_m = exp(psi z) R exp(mounting) exp(noise), z upward.

    psi is a random walk that begins with an offset: a gyroscope alone tells a heading, and nothing corrects it.

    Args:
        *settings, **changes: See `InertialUnitsSettings`; numbers may be tensors (...), one a row.
        period: s between two readings.

    Raises:
        ValueRangeError: A setting is out of range.

    Example:
        >>> units, R = InertialUnits(heading=0.2, heading_drift=0.01), torch.eye(3).repeat(2, 1, 1)
        >>> state = units.initial_state(R[..., 0, 0], torch.Generator().manual_seed(0))
        >>> state, seen = units(state, R, torch.zeros(2, 4))
        >>> seen.shape, bool((state.heading != 0).all())
        (torch.Size([2, 3, 3]), True)
    """

    settings_type = InertialUnitsSettings
    tilt_noise: Setting
    mounting: Setting
    heading: Setting
    heading_drift: Setting

    def __init__(self, *settings: Any, period: float = 0.02, **changes: Any) -> None:
        super().__init__()
        self.period = period
        self.hold(resolved(InertialUnitsSettings, settings, changes))

    @property
    def noisy(self) -> bool:
        """Whether a reading depends on chance."""
        return is_on(self.tilt_noise) or is_on(self.heading_drift)

    def initial_state(self, like: Tensor, generator: torch.Generator | None = None, shared: int = 0) -> InertialState:
        """How units sit, and their headings at the start.

        Args:
            like: (..., p) of the units' shape, dtype and device.
            generator: Where chance comes from; None for torch's global one.
            shared: Number of leading dimensions over which it is the same.
        """
        drawn = like.new_zeros(*like.shape[shared:], 4)
        if is_on(self.mounting) or is_on(self.heading):
            drawn = torch.randn(drawn.shape, dtype=like.dtype, device=like.device, generator=generator)
        drawn = drawn.expand(*like.shape, 4)
        return InertialState(drawn[..., :3] * aligned(self.mounting, 2), drawn[..., 3] * aligned(self.heading, 1))

    def forward(self, state: InertialState, R: Tensor, draws: Tensor | None) -> tuple[InertialState, Tensor]:
        """The next state, and a reading.

        Args:
            state: From `initial_state` or the last reading.
            R: (..., p, 3, 3) true orientations.
            draws: (..., p, 4) standard normal; None where nothing is `noisy`.
        """
        turn, heading = so3.exp(state.mounting), state.heading
        if draws is not None:
            turn = turn @ so3.exp(draws[..., :3] * aligned(self.tilt_noise, 2))
            heading = heading + draws[..., 3] * aligned(self.heading_drift, 1) * self.period**0.5
        none = torch.zeros_like(heading)
        seen = so3.exp(torch.stack((none, none, heading), dim=-1)) @ R @ turn
        return InertialState(state.mounting, heading), seen
