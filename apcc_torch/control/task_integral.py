"""Integral action on the task error, near the target alone."""

from __future__ import annotations

import torch
from torch import Tensor

from apcc_torch.part import Part, hold
from apcc_torch.settings import Setting, aligned, check_setting


class TaskIntegral(Part):
    """z in K (e + z) for the K e of Eq. (14):  zdot = gain e / (1 + (|e| / reach)^4).

    A soft arm creeps under its load, and a motion in the null space of a model that is wrong moves the tip: K e has to
    stand against both, so the tip rests off its target, by that velocity over K. z takes it over. An error much larger
    than `reach` leaves z as it is: on a long way to a set-point nothing winds up.

    The loop already integrates, qdot to q_d, so a large gain overshoots: with z the tip has s^2 + K s + K gain, which
    swings where gain > K / 4, and the arm's own lag leaves less than that.

    Args:
        gain: 1/s, a number or (...) one a row.
        reach: m, likewise.

    Raises:
        ValueRangeError: The gain is negative, the reach not positive, or one is not finite.
    """

    gain: Setting
    reach: Setting

    def __init__(self, gain: Setting = 1.0, reach: Setting = 1e-3) -> None:
        super().__init__()
        check_setting("gain", gain, zero=True)
        check_setting("reach", reach)
        hold(self, gain=gain, reach=reach)

    def forward(self, z: Tensor, e: Tensor, dt: Tensor) -> Tensor:
        """z (..., 3), m, after dt (...) s with the error e (..., 3), m, as it was where e is not finite; unchecked."""
        near = 1.0 / (1.0 + ((e * e).sum(-1, keepdim=True) / aligned(self.reach, 1) ** 2).square())
        later = z + (aligned(self.gain, 1) * dt.unsqueeze(-1)) * (near * e)
        return torch.where(torch.isfinite(later), later, z)
