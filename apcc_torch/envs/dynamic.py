"""The dynamic arm: section V-B's plant of six sections under tendons, whose lengths a PID loop holds."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor, nn
from torch.func import functional_call

from apcc_torch.control.pid import ramp
from apcc_torch.envs.arm import Arm
from apcc_torch.envs.backbone_points import backbone_points, powers
from apcc_torch.envs.randomisation import RowParameters
from apcc_torch.linalg import solve_spd
from apcc_torch.model.integrators import ArmState
from apcc_torch.simulation.plant import Plant


class DynamicState(NamedTuple):
    """The arm, and the integral z (N, 9) of its tendon loop, m s."""

    arm: ArmState
    z: Tensor


class _Moves(nn.Module):
    """One control period of the plant, as a module so that `functional_call` can give each row its own arm."""

    def __init__(self, plant: Plant, period: float, substeps: int) -> None:
        super().__init__()
        self.plant, self.period, self.substeps = plant, period, substeps

    def forward(self, state: DynamicState, y: Tensor, y_next: Tensor) -> DynamicState:
        arm, z = state
        for i in range(1, self.substeps + 1):
            reference = ramp(y, y_next, i / self.substeps, self.period)
            arm, z = self.plant.step(arm, z, reference, self.period / self.substeps)
        return DynamicState(arm, z)


class _Weight(nn.Module):
    """The generalized force (N, 18) of gravity on the plant, for `functional_call` likewise."""

    def __init__(self, plant: Plant) -> None:
        super().__init__()
        self.plant = plant

    def forward(self, q: Tensor) -> Tensor:
        return self.plant.dynamics.gravity(q, self.plant.payload)


class DynamicArm(nn.Module):
    """N arms of six sections; lengths, stiffness and payload may differ from row to row.

    Sensors and racks sit where the model's sections end, on every row's own arm, so the tendons' B is one for all.

    Args:
        arm: Their numbers.
        period: Control period, s.
        substeps: Plant steps in it.
        varied: Whether lengths or stiffness differ from row to row; the payload always may.
        like: Dtype and device.
    """

    nominal: Tensor
    tips: Tensor

    def __init__(self, arm: Arm, period: float, substeps: int, varied: bool, like: Tensor) -> None:
        super().__init__()
        self.arm, self.varied = arm, varied
        dynamics = arm.dynamics(like)
        plant = Plant(dynamics, arm.routing(like), arm.pid(), like.new_zeros(()), arm.tendon_damping)
        self.moves = _Moves(plant, period, substeps)
        self.register_buffer("nominal", dynamics.lengths)
        self.register_buffer("tips", powers((1.0,), like))

    def lengths(self, rows: RowParameters) -> Tensor:
        """(N, 6) true rest lengths, m."""
        return self.nominal * rows.lengths.repeat_interleave(2, dim=-1)

    def initial(self, rows: RowParameters) -> DynamicState:
        """Arms at rest under gravity, their tendons held at their zero lengths.

        An arm that hangs straight has no force on its bends, and the one on its elongations does not depend on them:
        (K + K_P B B^T) q = -G(0) holds there, not only near it.
        """
        plant, own = self.moves.plant, self._own(rows)
        zero = torch.zeros_like(self.lengths(rows)).repeat_interleave(3, dim=-1)
        gravity = functional_call(_Weight(plant), own, (zero,))
        stiffness = own.get("plant.dynamics.stiffness_diagonal", plant.dynamics.stiffness_diagonal)
        held = torch.diag_embed(stiffness) + plant.actuation_stiffness
        q = solve_spd(held.expand(*zero.shape, -1), -gravity.unsqueeze(-1)).squeeze(-1)
        return DynamicState(ArmState(q, zero), torch.zeros_like(plant.lengths(zero)))

    def step(self, state: DynamicState, y: Tensor, y_next: Tensor, q_d: Tensor, rows: RowParameters) -> DynamicState:
        """The arms after one control period in which their tendons' references go from y to y_next (N, 9), m."""
        later: DynamicState = functional_call(self.moves, self._own(rows), (state, y, y_next))
        return later

    def points(self, state: DynamicState, rows: RowParameters) -> Tensor:
        """(N, 6, 3) m: the end of every section, which are the middle and the end of each of the model's."""
        return backbone_points(state.arm.q, self.lengths(rows), self.moves.plant.dynamics.base_rotation, self.tips)

    def tendons(self, state: DynamicState) -> Tensor:
        """(N, 9) tendon length changes, m."""
        return self.moves.plant.lengths(state.arm.q)

    def configuration(self, state: DynamicState) -> Tensor:
        """q (N, n) of the true arm."""
        return state.arm.q

    def coordinates(self, state: DynamicState) -> tuple[Tensor, ...]:
        """What must stay finite and within bounds, each (N, n)."""
        return *state.arm, state.z

    def _own(self, rows: RowParameters) -> dict[str, Tensor]:
        """The plant's buffers that each row has for itself."""
        own = {"plant.payload": rows.payload}
        if self.varied:
            lengths, dynamics = self.lengths(rows), self.moves.plant.dynamics
            # Springs in series: a section is softer as it is longer.
            factor = (rows.stiffness.unsqueeze(-1) / rows.lengths).repeat_interleave(6, dim=-1)
            own |= {
                "plant.dynamics.lengths": lengths,
                "plant.dynamics.masses": self.arm.masses(lengths),
                "plant.dynamics.stiffness_diagonal": dynamics.stiffness_diagonal * factor,
                "plant.dynamics.damping_diagonal": dynamics.damping_diagonal * factor,
                "plant.dynamics.batch_marker": torch.zeros_like(rows.payload),
            }
        return own
