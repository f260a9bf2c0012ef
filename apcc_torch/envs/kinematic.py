"""The kinematic arm: it follows q_d exactly, as in section V-A. A payload or its stiffness does not change it."""

from __future__ import annotations

from typing import NamedTuple

from torch import Tensor

from apcc_torch.envs.backbone_points import BackbonePoints, Positions
from apcc_torch.envs.places import middles_and_ends, sensors_of
from apcc_torch.envs.randomisation import RowParameters
from apcc_torch.model.arm import Arm
from apcc_torch.part import Part


class KinematicState(NamedTuple):
    """q (N, n) rad, rad, m."""

    q: Tensor


class KinematicArm(Part):
    """N arms of the model's sections.

    Args:
        arm: What each of them is nominally.
        like: Dtype and device.
    """

    nominal: Tensor
    B: Tensor

    def __init__(self, arm: Arm, like: Tensor) -> None:
        super().__init__()
        nominal = arm.rest_lengths().to(like)
        backbone = middles_and_ends(arm.n_sections)
        self.register_buffer("nominal", nominal)
        self.register_buffer("B", arm.routing().to(like).matrix(nominal))
        self.places = BackbonePoints(backbone, sensors_of(arm, true=True), 1, arm.base_rotation().to(like))

    def lengths(self, rows: RowParameters) -> Tensor:
        """(N, n_b) true rest lengths, m."""
        return self.nominal * rows.lengths

    def initial(self, rows: RowParameters) -> KinematicState:
        """Straight arms."""
        return KinematicState(rows.lengths.new_zeros(rows.lengths.shape).repeat_interleave(3, dim=-1))

    def step(
        self, state: KinematicState, y: Tensor, y_next: Tensor, q_d: Tensor, rows: RowParameters
    ) -> KinematicState:
        """The arms at q_d."""
        return KinematicState(q_d)

    def points(self, state: KinematicState, rows: RowParameters) -> Positions:
        """Where they are."""
        positions: Positions = self.places(state.q, self.lengths(rows))
        return positions

    def tendons(self, state: KinematicState) -> Tensor:
        """(N, n_a) tendon length changes, m."""
        return state.q @ self.B

    def configuration(self, state: KinematicState) -> Tensor:
        """q (N, n) of the true arm."""
        return state.q

    def coordinates(self, state: KinematicState) -> tuple[Tensor, ...]:
        """What must stay finite and within bounds, each (N, n)."""
        return state
