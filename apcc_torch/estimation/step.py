"""Damped steps of algorithm 2: weighted least squares, and positions first with orientations in their null space."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from apcc_torch.linalg import damped_pseudo_inverse, solve_spd


class Residual(NamedTuple):
    """What is left between the sensors and the model.

    angular: (..., k, 3) rad, zero where not used.
    linear: (..., k, 3) m, zero where not used.
    body: (..., k, 6, n) body Jacobians at the sensors.
    usable: (..., k) bool, sensors that count.
    oriented: (..., k) bool, sensors whose orientation counts.
    """

    angular: Tensor
    linear: Tensor
    body: Tensor
    usable: Tensor
    oriented: Tensor


def _stacked(rows: Tensor, used: Tensor) -> Tensor:
    """(..., k, 3, n) rows of k sensors to (..., 3 k, n), zero where not used."""
    return torch.where(used[..., None, None], rows, 0.0).flatten(-3, -2)


def least_squares_step(residual: Residual, angular_weight: float | None, damping: Tensor) -> Tensor:
    """(J^T W J + damping I)^-1 J^T W r, Eq. (31) as a damped least-squares step, (..., n).

    Args:
        residual: At the current configuration.
        angular_weight: m/rad; None for positions only, Eq. (32).
        damping: (...) m^2.
    """
    J = _stacked(residual.body[..., 3:, :], residual.usable)
    r = residual.linear.flatten(-2)
    if angular_weight is not None:
        J = torch.cat((J, angular_weight * _stacked(residual.body[..., :3, :], residual.oriented)), dim=-2)
        r = torch.cat((r, angular_weight * residual.angular.flatten(-2)), dim=-1)
    identity = torch.eye(J.shape[-1], dtype=J.dtype, device=J.device)
    normal = J.mT @ J + damping[..., None, None] * identity
    return solve_spd(normal, J.mT @ r.unsqueeze(-1)).squeeze(-1)


def hierarchical_step(residual: Residual, damping: Tensor) -> Tensor:
    """Positions first; orientations move only what positions leave free, (..., n).

    With J_p, J_w the stacked linear and angular rows, P = J_p^+ and N = I - P J_p the null-space projector:
    dq = P r_p + N (J_w N)^+ (r_w - J_w P r_p).

    Args:
        residual: At the current configuration.
        damping: (...) m^2, of the position step; the same number damps the angular step, rad^2.
    """
    J_p = _stacked(residual.body[..., 3:, :], residual.usable)
    J_w = _stacked(residual.body[..., :3, :], residual.oriented)
    root = damping.sqrt()[..., None, None]
    P = damped_pseudo_inverse(J_p, root)
    first = P @ residual.linear.flatten(-2).unsqueeze(-1)
    N = torch.eye(J_p.shape[-1], dtype=J_p.dtype, device=J_p.device) - P @ J_p
    # A floor well above the position damping: where positions leave no freedom, N is round-off, not to be inverted.
    free = damped_pseudo_inverse(J_w @ N, torch.clamp(root, min=1e-3))
    second = N @ (free @ (residual.angular.flatten(-2).unsqueeze(-1) - J_w @ first))
    return (first + second).squeeze(-1)
