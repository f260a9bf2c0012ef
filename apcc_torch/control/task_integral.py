"""Integral action on the task error, near the target alone."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from apcc_torch.part import Part
from apcc_torch.settings import OURS, Setting, Settings, aligned, resolved, setting


@dataclass(frozen=True, kw_only=True)
class TaskIntegralSettings(Settings):
    """Settings of `TaskIntegral`."""

    gain: Setting = setting(1.0, "1/s", OURS, "of the integral of the task error in K (e + z)", rows="number", least=0)
    reach: Setting = setting(1e-3, "m", OURS, "errors much larger than this are not integrated", rows="number", above=0)


class TaskIntegral(Part):
    """z in K (e + z) for the K e of Eq. (14):  zdot = gain e / (1 + (|e| / reach)^4).

    A soft arm creeps under its load, and a motion in the null space of a model that is wrong moves the tip: K e has to
    stand against both, so the tip rests off its target, by that velocity over K. z takes it over. An error much larger
    than `reach` leaves z as it is: on a long way to a set-point nothing winds up.

    The loop already integrates, qdot to q_d, so a large gain overshoots: with z the tip has s^2 + K s + K gain, which
    swings where gain > K / 4, and the arm's own lag leaves less than that.

    Args:
        *settings, **changes: See `TaskIntegralSettings`; each number may be a tensor (...), one a row.

    Raises:
        ValueRangeError: A setting is out of range.

    Example:
        >>> z, e = torch.zeros(3), torch.tensor([1e-4, 0.0, 0.0])
        >>> 1e6 * TaskIntegral(gain=2.0)(z, e, torch.tensor(0.01))
        tensor([1.9998, 0.0000, 0.0000])
    """

    settings_type = TaskIntegralSettings
    gain: Setting
    reach: Setting

    def __init__(self, *settings: Any, **changes: Any) -> None:
        super().__init__()
        self.hold(resolved(TaskIntegralSettings, settings, changes))

    def forward(self, z: Tensor, e: Tensor, dt: Tensor) -> Tensor:
        """z (..., 3), m, after dt (...) s with the error e (..., 3), m, as it was where e is not finite; unchecked."""
        near = 1.0 / (1.0 + ((e * e).sum(-1, keepdim=True) / aligned(self.reach, 1) ** 2).square())
        later = z + (aligned(self.gain, 1) * dt.unsqueeze(-1)) * (near * e)
        return torch.where(torch.isfinite(later), later, z)
