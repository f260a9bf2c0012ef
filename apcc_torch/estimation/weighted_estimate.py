"""Weighted least squares of a few unknowns, r = Phi theta + noise, which says what it does not know."""

from __future__ import annotations

from enum import IntEnum
from typing import NamedTuple

import torch
from torch import Tensor

from apcc_torch.linalg import solve_spd
from apcc_torch.modes import full_precision
from apcc_torch.shapes import broadcast

# How much wider than the limit of what counts as known the unknowns may lie: a prior that keeps the solve regular.
PRIOR = 100.0


class EstimateStatus(IntEnum):
    """What a row of an estimate is worth.

    Example:
        >>> EstimateStatus(0)
        <EstimateStatus.DETERMINED: 0>
    """

    DETERMINED = 0
    """Every component is known."""
    PARTLY = 1
    """Some components are known; the others are NaN."""
    UNDETERMINED = 2
    """The equations say nothing within the limit of any component: all are NaN."""
    INVALID = 3
    """The input is not finite, its covariance not positive definite, or no arm at rest fits it: all are NaN."""


class WeightedEstimate(NamedTuple):
    """Unknowns of a linear model.

    value: (..., p), NaN where a component is not determined.
    covariance: (..., p, p). An unknown direction has a variance of the order of (`PRIOR` times the limit) squared.
    residual: (..., n) r - Phi theta.
    misfit: (...) r^T S^-1 r of that residual: the noise alone leaves n - p on average.
    status: (...) int64 `EstimateStatus`.
    """

    value: Tensor
    covariance: Tensor
    residual: Tensor
    misfit: Tensor
    status: Tensor

    @property
    def deviation(self) -> Tensor:
        """Standard deviation of every component (..., p)."""
        return self.covariance.diagonal(dim1=-2, dim2=-1).sqrt()

    def to(self, dtype: torch.dtype) -> WeightedEstimate:
        """The estimate in another precision."""
        value, covariance, residual, misfit = (v.to(dtype) for v in self[:-1])
        return WeightedEstimate(value, covariance, residual, misfit, self.status)


@full_precision
def weighted_estimate(r: Tensor, Phi: Tensor, S: Tensor, limit: Tensor) -> WeightedEstimate:
    """The unknowns theta of r = Phi theta, weighted by S^-1.

    A component whose standard deviation is above its limit is not determined, and reported as NaN. A direction that no
    equation sees costs the others nothing.

    Args:
        r: (..., n).
        Phi: (..., n, p).
        S: (..., n, n) covariance of r.
        limit: (p,) largest standard deviation of a component that counts as determined.

    Example:
        >>> Phi, r = torch.tensor([[1.0, 0.0], [1.0, 0.0]]).double(), torch.tensor([0.9, 1.1]).double()
        >>> estimate = weighted_estimate(r, Phi, torch.eye(2).double(), torch.tensor([10.0, 10.0]).double())
        >>> estimate.value
        tensor([1.0000,    nan], dtype=torch.float64)
        >>> EstimateStatus(int(estimate.status)).name
        'PARTLY'
    """
    batch = broadcast(r.shape[:-1], Phi.shape[:-2], S.shape[:-2])
    r, Phi = r.expand(*batch, r.shape[-1]), Phi.expand(*batch, *Phi.shape[-2:])
    both = torch.cat((Phi, r.unsqueeze(-1)), dim=-1)
    weighted = solve_spd(S, both)
    information = Phi.mT @ weighted[..., :-1] + torch.diag_embed((PRIOR * limit) ** -2)
    identity = torch.eye(Phi.shape[-1], dtype=r.dtype, device=r.device).expand_as(information)
    covariance = solve_spd(information, identity)
    theta = (covariance @ (Phi.mT @ weighted[..., -1:])).squeeze(-1)
    residual = r - (Phi @ theta.unsqueeze(-1)).squeeze(-1)
    misfit = (residual * solve_spd(S, residual.unsqueeze(-1)).squeeze(-1)).sum(-1)
    known = covariance.diagonal(dim1=-2, dim2=-1) <= limit**2
    status = torch.where(known.any(-1), int(EstimateStatus.PARTLY), int(EstimateStatus.UNDETERMINED))
    status = torch.where(known.all(-1), int(EstimateStatus.DETERMINED), status)
    finite = torch.isfinite(theta).all(-1) & torch.isfinite(misfit)
    status = torch.where(finite, status, int(EstimateStatus.INVALID))
    value = torch.where(known & finite.unsqueeze(-1), theta, torch.nan)
    return WeightedEstimate(value, covariance, residual, misfit, status)
