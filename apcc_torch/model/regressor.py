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


def _angular_velocity(spin: Tensor, thetadot: Tensor) -> Tensor:
    """(..., n, 3) angular velocity of each section's base frame: the sum over the sections before it."""
    own = _times(spin, thetadot)
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
    thetadot = torch.stack((xdot, ydot), dim=-1)
    columns = before @ arcs.columns
    chord = columns[..., 4]
    omega = _angular_velocity(columns[..., :2], thetadot)
    Y = torch.linalg.cross(omega, chord) + _times(columns[..., 2:4], thetadot)  # Eq. (8), of the true parameters
    Phi = (Y * dL.unsqueeze(-1) + chord * dLdot.unsqueeze(-1)).sum(-2)  # Eq. (10)
    return Y.mT, Phi


def jacobian_rate(chain: Chain, qdot: Sections) -> Tensor:
    """Jdot (..., 3, 3 n_b) of the chain's tip along qdot. Its columns of delta L are the regressor Y of Eq. (8).

    Args:
        chain: The chain.
        qdot: Rates of Delta_x, Delta_y (rad/s) and delta L (m/s), each (..., n_b).
    """
    xdot, ydot, lengthdot = qdot
    rate = arc_rate(chain.x, chain.y, xdot, ydot, chain.c)
    columns = chain.before @ chain.arcs.columns
    spin, reach = columns.split_with_sizes((2, 3), dim=-1)  # what turns; what moves: bend and chord
    omega = _angular_velocity(spin, torch.stack((xdot, ydot), dim=-1)).unsqueeze(-1)
    turned = chain.before @ rate.columns
    spin_rate = torch.linalg.cross(omega, spin, dim=-2) + turned[..., :2]
    reach_rate = torch.linalg.cross(omega, reach, dim=-2) + turned[..., 2:]

    # The steps L u turn and stretch; what lies beyond section i moves with the later steps only.
    L, Ldot = chain.length[..., None, None], lengthdot[..., None, None]
    bend_rate, step_rate = torch.addcmul(Ldot * reach, L, reach_rate).split_with_sizes((2, 1), dim=-1)
    ends_rate = step_rate.cumsum(-3)
    arm = (chain.tip.unsqueeze(-2) - chain.ends).unsqueeze(-1)
    arm_rate = ends_rate[..., -1:, :, :] - ends_rate
    swing = torch.linalg.cross(spin_rate, arm, dim=-2) + torch.linalg.cross(spin, arm_rate, dim=-2)
    return flatten_columns(torch.cat((bend_rate + swing, reach_rate[..., 2:]), dim=-1))
