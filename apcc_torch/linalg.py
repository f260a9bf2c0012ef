"""Small symmetric positive definite systems, in one place so that they can be made fast in one place."""

from __future__ import annotations

import torch
from torch import Tensor


def solve_spd(A: Tensor, B: Tensor) -> Tensor:
    """Solves A X = B for symmetric positive definite A; a row whose A is not positive definite gives NaN in that row.

    Args:
        A: (..., n, n).
        B: (..., n, m).
    """
    factor, failed = torch.linalg.cholesky_ex(A)
    return torch.cholesky_solve(B, factor).masked_fill(failed[..., None, None] != 0, torch.nan)


def damped_pseudo_inverse(J: Tensor, damping: float | Tensor) -> Tensor:
    """J^T (J J^T + damping^2 I)^-1, (..., n, m) for J (..., m, n): the least-norm step, bounded near singularities.

    Of the two equal forms, the other being (J^T J + damping^2 I)^-1 J^T, the smaller matrix is solved: the larger one
    is singular but for the damping.
    """
    m, n = J.shape[-2:]
    identity = torch.eye(min(m, n), dtype=J.dtype, device=J.device)
    if m > n:
        return solve_spd(J.mT @ J + damping * damping * identity, J.mT)
    return solve_spd(J @ J.mT + damping * damping * identity, J).mT
