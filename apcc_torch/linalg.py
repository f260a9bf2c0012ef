"""Small symmetric positive definite systems: all solves and factors go through here; and rows held to a bound."""

from __future__ import annotations

import torch
from torch import Tensor

from apcc_torch.modes import full_precision
from apcc_torch.settings import Setting, aligned
from apcc_torch.shapes import broadcast

# Where writing the elimination out is faster than the library's batched call: a factor of two at 256 matrices of this
# size and of six at 4096; at larger sizes the library is as fast or faster (docs/speed.md).
UNROLLED_SIZE = 3
UNROLLED_ROWS = 256


def solve_spd(A: Tensor, B: Tensor) -> Tensor:
    """Solves A X = B for symmetric positive definite A; a row whose A is not positive definite gives NaN in that row.

    Args:
        A: (..., n, n).
        B: (..., n, m).
    """
    n = A.shape[-1]
    # Compiled, the few operations become one, and the batch may be of any size.
    if n <= UNROLLED_SIZE and (torch.compiler.is_compiling() or A.numel() >= UNROLLED_ROWS * n * n):
        return solve_spd_unrolled(A, B)
    factor, failed = torch.linalg.cholesky_ex(A)
    return torch.cholesky_solve(B, factor).masked_fill(failed[..., None, None] != 0, torch.nan)


def solve_floored(A: Tensor, B: Tensor, floor: float) -> Tensor:
    """Solves A X = B for symmetric A without negative eigenvalues, B in its range; a row that has some gives NaN.

    Directions in which A is zero to rounding get next to nothing. In another one, of eigenvalue s, the floor that holds
    them costs the relative error (floor / s)^2: it is added to A, and what it took is given back once.

    Args:
        A: (..., n, n).
        B: (..., n, m).
        floor: Far below the eigenvalues that count, and far above their rounding.
    """
    factor, failed = torch.linalg.cholesky_ex(A + floor * torch.eye(A.shape[-1], dtype=A.dtype, device=A.device))
    X = torch.cholesky_solve(B, factor)
    X = torch.add(X, torch.cholesky_solve(X, factor), alpha=floor)
    return X.masked_fill(failed[..., None, None] != 0, torch.nan)


def solve_spd_unrolled(A: Tensor, B: Tensor) -> Tensor:
    """`solve_spd` by A = L D L^T written out, the batch in the innermost dimension; differentiable."""
    n, batch = A.shape[-1], broadcast(A.shape[:-2], B.shape[:-2])
    a, y = (value.expand(*batch, *value.shape[-2:]).movedim((-2, -1), (0, 1)) for value in (A, B))
    columns, pivots, rest = [], [], []
    positive = torch.ones_like(a[0, 0], dtype=torch.bool)
    for j in range(n):
        positive = positive & (a[0, 0] > 0)
        column = a[1:, 0] / a[0, 0]
        columns.append(column)
        pivots.append(a[0, 0])
        rest.append(y[0])
        if j < n - 1:
            a = a[1:, 1:] - column.unsqueeze(1) * a[0, 1:]
            y = y[1:] - column.unsqueeze(1) * y[0]
    solution: list[Tensor] = []  # from the last unknown to the first
    for j in reversed(range(n)):
        x = rest[j] / pivots[j]
        for k, known in enumerate(reversed(solution)):
            x = x - columns[j][k] * known
        solution.append(x)
    result = torch.stack(solution[::-1]).movedim((0, 1), (-2, -1))
    return torch.where(positive[..., None, None], result, torch.nan)


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


@full_precision
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


def scaled_within(x: Tensor, bound: Setting | None, of: Tensor | None = None) -> Tensor:
    """x (..., n), a row scaled whole where an entry's magnitude is over `bound`, a number or (...); None for no bound.

    The bound is positive; a row within it is divided by one, and stays what it is to the last bit.

    Args:
        x: The rows.
        bound: The bound.
        of: (..., m) the entries that it bounds; None for all.
    """
    if bound is None:
        return x
    return x / ((x if of is None else of).abs().amax(-1, keepdim=True) / aligned(bound, 1)).clamp(min=1.0)
