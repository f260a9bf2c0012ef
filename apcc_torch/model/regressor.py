"""Theorem 1 in closed form: the tip velocity is linear in the rest lengths, for any number of sections.

Rotations do not depend on lengths, and x = sum_i R_{i-1} u_i (L0_i + dL_i). Differentiating,

    xdot = sum_i Y_i (L0_i + dL_i) + R_{i-1} u_i dLdot_i,
    Y_i = d/dt (R_{i-1} u_i) = w_{i-1} x R_{i-1} u_i + R_{i-1} udot_i,

where w_{i-1} is the angular velocity of section i's base. So Y collects the Y_i and Phi is what does not meet L0.
"""

from __future__ import annotations

import torch
from torch import Tensor

from apcc_torch.model.arc import arc_geometry, arc_rate
from apcc_torch.model.chain import Chain, flatten_columns, prefix_rotations

Sections = tuple[Tensor, Tensor, Tensor]


def _times(matrix: Tensor, vector: Tensor) -> Tensor:
    return (matrix @ vector.unsqueeze(-1)).squeeze(-1)


def _angular_velocity(spin: Tensor, before: Tensor, xdot: Tensor, ydot: Tensor) -> Tensor:
    """(..., n, 3) angular velocity of each section's base frame: the sum over the sections before it."""
    own = _times(before, _times(spin, torch.stack((xdot, ydot), dim=-1)))
    return own.cumsum(-2) - own


def linear_regressor(q: Sections, qdot: Sections, base_rotation: Tensor) -> tuple[Tensor, Tensor]:
    """Y (..., 3, n_b) and Phi (..., 3) of Eq. (2) [Dalenberg].

    Args:
        q: Delta_x, Delta_y (rad) and delta L (m), each (..., n_b).
        qdot: Their rates, rad/s and m/s.
        base_rotation: (3, 3).
    """
    x, y, dL = q
    xdot, ydot, dLdot = qdot
    arcs = arc_geometry(x, y)
    before, _ = prefix_rotations(arcs.rotation, base_rotation)
    omega = _angular_velocity(arcs.spin, before, xdot, ydot)
    chord = _times(before, arcs.chord)
    chord_rate = _times(before, _times(arcs.bend, torch.stack((xdot, ydot), dim=-1)))
    Y = torch.linalg.cross(omega, chord) + chord_rate  # Eq. (8), the columns of the true parameters
    Phi = (Y * dL.unsqueeze(-1) + chord * dLdot.unsqueeze(-1)).sum(-2)  # Eq. (10)
    return Y.mT, Phi


def jacobian_rate(chain: Chain, q: Sections, qdot: Sections) -> Tensor:
    """Jdot (..., 3, 3 n_b) of the chain's tip along qdot.

    Args:
        chain: The chain at q.
        q: Delta_x, Delta_y (rad) and the section length L0 + dL (m), each (..., n_b).
        qdot: Their rates.
    """
    x, y, length = q
    xdot, ydot, lengthdot = qdot
    arcs, before = chain.arcs, chain.before
    rate = arc_rate(x, y, xdot, ydot)
    omega = _angular_velocity(arcs.spin, before, xdot, ydot).unsqueeze(-1)
    L, Ldot = length[..., None, None], lengthdot[..., None, None]

    local = torch.cat((arcs.spin, L * arcs.bend, arcs.chord.unsqueeze(-1)), dim=-1)
    local_rate = torch.cat((rate.spin, Ldot * arcs.bend + L * rate.bend, rate.chord.unsqueeze(-1)), dim=-1)
    world = before @ local
    world_rate = torch.linalg.cross(omega, world, dim=-2) + before @ local_rate

    # The steps R t turn and stretch; what lies beyond section i moves with the later steps only.
    step_rate = Ldot * world[..., 4:] + L * world_rate[..., 4:]
    ends_rate = step_rate.cumsum(-3)
    arm = (chain.tip.unsqueeze(-2) - chain.ends).unsqueeze(-1)
    arm_rate = ends_rate[..., -1:, :, :] - ends_rate
    spin, spin_rate = world[..., :2], world_rate[..., :2]
    swing = torch.linalg.cross(spin_rate, arm, dim=-2) + torch.linalg.cross(spin, arm_rate, dim=-2)
    return flatten_columns(torch.cat((world_rate[..., 2:4] + swing, world_rate[..., 4:]), dim=-1))
