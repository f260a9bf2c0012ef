"""Theorem 1 in closed form: the tip velocity is linear in the rest lengths, for any number of sections.

Rotations do not depend on lengths, and x = sum_i R_{i-1} u_i (L0_i + dL_i). Differentiating,

    xdot = sum_i Y_i (L0_i + dL_i) + R_{i-1} u_i dLdot_i,
    Y_i = d/dt (R_{i-1} u_i) = w_{i-1} x R_{i-1} u_i + R_{i-1} udot_i,

where w_{i-1} is the angular velocity of section i's base. So Y collects the Y_i and Phi is what does not meet L0.
"""

from __future__ import annotations

import torch
from torch import Tensor

from apcc_torch.model.arc import arc_geometry
from apcc_torch.model.chain import angular_velocity, prefix_rotations

Sections = tuple[Tensor, Tensor, Tensor]


def _times(matrix: Tensor, vector: Tensor) -> Tensor:
    return (matrix @ vector.unsqueeze(-1)).squeeze(-1)


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
    omega = angular_velocity(columns[..., :2], thetadot)
    Y = torch.linalg.cross(omega, chord) + _times(columns[..., 2:4], thetadot)  # Eq. (8), of the true parameters
    Phi = (Y * dL.unsqueeze(-1) + chord * dLdot.unsqueeze(-1)).sum(-2)  # Eq. (10)
    return Y.mT, Phi
