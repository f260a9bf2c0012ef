"""How large an arm is drawn."""

from __future__ import annotations

from typing import NamedTuple, Self

from apcc_torch.model.arm import Arm
from apcc_torch.model.arm_scale import length, tendon_force

TIGHT = 0.6
"""Tension that is drawn as tight, over what a tendon's force is weighed against."""


class DrawnSize(NamedTuple):
    """The size of a scene.

    length: Of the arm, m. radius: Of its tube, m, within its tendons. upward: Whether it stands; else it hangs.
    tension: Of a tendon that is drawn as tight, N.
    """

    length: float
    radius: float
    upward: bool
    tension: float

    @classmethod
    def of(cls, arm: Arm) -> Self:
        """The size of one arm.

        Example:
            >>> DrawnSize.of(Arm(lengths=[0.2, 0.25], tendon_offset=0.02)).radius
            0.012
        """
        offset = float(arm.routing().offsets.max())
        upward = bool(arm.base_rotation()[2, 2] > 0)
        return cls(length(arm), 0.6 * offset, upward, TIGHT * tendon_force(arm))
