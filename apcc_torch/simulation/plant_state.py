"""What a simulated true arm remembers."""

from __future__ import annotations

from typing import NamedTuple

from torch import Tensor

from apcc_torch.model.integrators import ArmState


class PlantState(NamedTuple):
    """The true arm.

    z: (R, n_a) integral of its tendon loop, m s. diverged_at: (R,) int64, see `DynamicLog`. time: (R,) s since it had
    settled. held: (R, n_a) to where the motors have drawn the tendons, m; of chambers, their pressures, Pa.
    """

    arm: ArmState
    z: Tensor
    diverged_at: Tensor
    time: Tensor
    held: Tensor
