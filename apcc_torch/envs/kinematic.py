"""The kinematic arm: it follows q_d exactly, as in section V-A. A payload or its stiffness does not change it."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor, nn

from apcc_torch.envs.arm import Arm
from apcc_torch.envs.backbone_points import backbone_points, powers
from apcc_torch.envs.randomisation import RowParameters


class KinematicState(NamedTuple):
    """q (N, 9) rad, rad, m."""

    q: Tensor


class KinematicArm(nn.Module):
    """N arms of three sections.

    Args:
        arm: Their numbers.
        like: Dtype and device.
    """

    nominal: Tensor
    base: Tensor
    halves: Tensor
    B: Tensor

    def __init__(self, arm: Arm, like: Tensor) -> None:
        super().__init__()
        nominal = arm.lengths(like)
        self.register_buffer("nominal", nominal)
        self.register_buffer("base", arm.base(like))
        self.register_buffer("halves", powers((0.5, 1.0), like))
        self.register_buffer("B", arm.routing(like).matrix(nominal))

    def lengths(self, rows: RowParameters) -> Tensor:
        """(N, 3) true rest lengths, m."""
        return self.nominal * rows.lengths

    def initial(self, rows: RowParameters) -> KinematicState:
        """Arms that hang straight."""
        return KinematicState(torch.zeros_like(rows.lengths).repeat_interleave(3, dim=-1))

    def step(
        self, state: KinematicState, y: Tensor, y_next: Tensor, q_d: Tensor, rows: RowParameters
    ) -> KinematicState:
        """The arms at q_d."""
        return KinematicState(q_d)

    def points(self, state: KinematicState, rows: RowParameters) -> Tensor:
        """(N, 6, 3) m: the middle and the end of every section of the model."""
        return backbone_points(state.q, self.lengths(rows), self.base, self.halves)

    def tendons(self, state: KinematicState) -> Tensor:
        """(N, 9) tendon length changes, m."""
        return state.q @ self.B

    def configuration(self, state: KinematicState) -> Tensor:
        """q (N, n) of the true arm."""
        return state.q

    def coordinates(self, state: KinematicState) -> tuple[Tensor, ...]:
        """What must stay finite and within bounds, each (N, n)."""
        return state
