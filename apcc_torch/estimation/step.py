"""Damped steps of algorithm 2: weighted least squares, and positions first with orientations in their null space."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from apcc_torch.linalg import damped_pseudo_inverse, solve_spd


class Residual(NamedTuple):
    """What is left between the sensors and the model, as m right-hand sides of one linear problem.

    twists: (..., k, 6, m) angular (rad) over linear (m).
    body: (..., k, 6, n) body Jacobians at the sensors.
    weights: (..., k, 6, 1) weight of each row, in m/rad and without unit; zero for what does not count.
    """

    twists: Tensor
    body: Tensor
    weights: Tensor


def row_weights(angular: Tensor, linear: Tensor, dtype: torch.dtype) -> Tensor:
    """(..., k, 6, 1) weights of rows from those of angular and linear parts, each (..., k)."""
    both = torch.stack((angular, linear), dim=-1).to(dtype)
    return both.unsqueeze(-1).expand(*both.shape, 3).flatten(-2).unsqueeze(-1)


def least_squares_step(residual: Residual, damping: Tensor) -> Tensor:
    """(J^T W J + damping I)^-1 J^T W r, Eq. (31) as a damped least-squares step, (..., n, m).

    Args:
        residual: At the current configuration.
        damping: (...) m^2.
    """
    J = (residual.body * residual.weights).flatten(-3, -2)
    r = (residual.twists * residual.weights).flatten(-3, -2)
    identity = torch.eye(J.shape[-1], dtype=J.dtype, device=J.device)
    normal = torch.addcmul(J.mT @ J, damping[..., None, None], identity)
    return solve_spd(normal, J.mT @ r)


def hierarchical_step(residual: Residual, damping: Tensor) -> Tensor:
    """Positions first; orientations move only what positions leave free, (..., n, m).

    With J_p, J_w the stacked linear and angular rows, P = J_p^+ and N = I - P J_p the null-space projector:
    dq = P r_p + N (J_w N)^+ (r_w - J_w P r_p).

    Args:
        residual: At the current configuration.
        damping: (...) m^2, of the position step; the same number damps the angular step, rad^2.
    """
    J_w, J_p = ((residual.body * residual.weights)[..., rows, :].flatten(-3, -2) for rows in _PARTS)
    r_w, r_p = ((residual.twists * residual.weights)[..., rows, :].flatten(-3, -2) for rows in _PARTS)
    root = damping.sqrt()[..., None, None]
    P = damped_pseudo_inverse(J_p, root)
    first = P @ r_p
    N = torch.eye(J_p.shape[-1], dtype=J_p.dtype, device=J_p.device) - P @ J_p
    # A floor well above the position damping: where positions leave no freedom, N is round-off, not to be inverted.
    free = damped_pseudo_inverse(J_w @ N, torch.clamp(root, min=1e-3))
    return first + N @ (free @ (r_w - J_w @ first))


def damped_step(mode: str, residual: Residual, damping: Tensor) -> Tensor:
    """The step (..., n, m) of a mode of `StateFeedback`: positions first in mode "hierarchical", else least squares."""
    return (hierarchical_step if mode == "hierarchical" else least_squares_step)(residual, damping)


_PARTS = (slice(0, 3), slice(3, 6))  # angular, linear
