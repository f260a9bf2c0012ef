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


def inverse_spd3(A: Tensor) -> Tensor:
    """Inverse of symmetric positive definite A (..., 3, 3), read from its lower triangle; NaN where it is not.

    By A = L D L^T written out: a library call costs more than these few operations.
    """
    d0 = A[..., 0, 0]
    l10, l20 = A[..., 1, 0] / d0, A[..., 2, 0] / d0
    d1 = A[..., 1, 1] - l10 * A[..., 1, 0]
    l21 = (A[..., 2, 1] - l20 * A[..., 1, 0]) / d1
    d2 = A[..., 2, 2] - l20 * A[..., 2, 0] - l21 * l21 * d1
    positive = (d0 > 0) & (d1 > 0) & (d2 > 0)
    # L^-1 is unit lower triangular with -l10, -l21 and m20, and A^-1 = L^-T D^-1 L^-1.
    m20 = l10 * l21 - l20
    i0, i1, i2 = 1.0 / d0, 1.0 / d1, torch.where(positive, 1.0 / d2, torch.nan)
    x22, x21, x20 = i2, -l21 * i2, m20 * i2
    x11, x10, x00 = i1 - l21 * x21, -l10 * i1 - l21 * x20, i0 + l10 * l10 * i1 + m20 * x20
    return torch.stack((x00, x10, x20, x10, x11, x21, x20, x21, x22), dim=-1).unflatten(-1, (3, 3))


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
