"""Algorithm 1: where material points of the real arm lie on a model whose section lengths adapt."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from apcc_torch.shapes import batch_shape, check_same, check_tensor

_ROUNDING = 64.0
"""Units in the last place within which a point is at a section's end."""


class MaterialPoints(NamedTuple):
    """Where k material points lie on an arm, whatever its configuration.

    fraction: (..., k, n_b) part of each section that lies before the point.
    length: (..., k, n_b) rest length of that part, m.
    section: (..., k) int64 zero-based index of the section that the point is in.
    """

    fraction: Tensor
    length: Tensor
    section: Tensor

    @property
    def own(self) -> Tensor:
        """(..., k, n_b) one at the section that the point is in, zero at the others."""
        sections = torch.arange(self.fraction.shape[-1], device=self.section.device)
        return (self.section.unsqueeze(-1) == sections).to(self.fraction.dtype)

    def slides(self, L0: Tensor, X: Tensor) -> Tensor:
        """(..., k, n_b) change of each point's X_tilde per unit of each rest length; L0 (..., n_b), X (..., k) m.

        Eq. (25) differentiated: -1 / pi_j before section j, -X_tilde / pi_j in it; 0 once clamped. The last sensor
        often sits at the arm's very end, where bounds put it up to rounding: that counts as inside.
        """
        end = L0.cumsum(-1)[..., -1:] * (1.0 + _ROUNDING * torch.finfo(L0.dtype).eps)
        inside = (end >= X).to(L0.dtype) / torch.gather(L0, -1, self.section)
        return -self.fraction * inside.unsqueeze(-1)

    def with_tip(self, L0: Tensor) -> MaterialPoints:
        """The points and after them the arm's tip, for rest lengths L0 (..., n_b) of the same leading shape."""
        n_b = L0.shape[-1]
        fraction = torch.nn.functional.pad(self.fraction, (0, 0, 0, 1), value=1.0)
        section = torch.nn.functional.pad(self.section, (0, 1), value=n_b - 1)
        return MaterialPoints(fraction, torch.cat((self.length, L0.unsqueeze(-2)), dim=-2), section)


def decouple(X: Tensor, pi_hat: Tensor) -> tuple[Tensor, Tensor]:
    """Normalised abscissa and section of each material point. Algorithm 1, Eqs. (22)-(26), remark 3 [Dalenberg].

    Points beyond the model's total length are attached to the tip of its last section (remark 3). A point on a
    boundary belongs to the section that ends there. Both outputs follow pi_hat without branches; X_tilde is
    differentiable in X and pi_hat between boundary crossings.

    Args:
        X: (..., k) material abscissae of sensors or tendon anchors on the unstrained arm, m.
        pi_hat: (..., n_b) section rest lengths, m; leading dimensions broadcast with those of X.

    Returns:
        X_tilde (..., k), in [0, 1], and j (..., k) int64, zero-based section index.

    Raises:
        ShapeError: X or pi_hat has no trailing dimension, or the leading dimensions do not broadcast.
        DtypeError: Their dtypes differ.

    Example:
        >>> X_tilde, j = decouple(torch.tensor([0.1, 0.2, 0.5]), torch.tensor([0.2, 0.25]))
        >>> X_tilde, j
        (tensor([0.5000, 1.0000, 1.0000]), tensor([0, 0, 1]))
    """
    check_tensor("X", X, (None,))
    check_tensor("pi_hat", pi_hat, (None,))
    check_same(X=X, pi_hat=pi_hat)
    batch = batch_shape(X=(X, 1), pi_hat=(pi_hat, 1))
    return located(X.expand(*batch, X.shape[-1]), pi_hat.expand(*batch, pi_hat.shape[-1]))


def located(X: Tensor, pi_hat: Tensor) -> tuple[Tensor, Tensor]:
    """`decouple` for tensors (..., k) and (..., n_b) of one dtype and the same leading dimensions, unchecked."""
    upper = pi_hat.cumsum(-1)  # Eq. (23)
    # Eq. (24): the first section whose end is not before X, but for rounding, counted as the number of ends before X.
    end = upper * (1.0 + _ROUNDING * torch.finfo(X.dtype).eps)
    j = (end.unsqueeze(-2) < X.unsqueeze(-1)).sum(-1).clamp(max=pi_hat.shape[-1] - 1)
    length = torch.gather(pi_hat, -1, j)
    lower = torch.gather(upper, -1, j) - length
    X_tilde = ((X - lower) / length).clamp(0.0, 1.0)  # Eq. (25); the clamp is remark 3
    return whole(X_tilde), j


def whole(share: Tensor) -> Tensor:
    """Shares of a section, with what is none or all of it up to rounding made so; the derivative stays."""
    off = (share > 0.5).to(share.dtype) - share
    near = off.abs() < _ROUNDING * torch.finfo(share.dtype).eps
    return share + torch.where(near, off, 0.0).detach()


def section_fractions(X_tilde: Tensor, j: Tensor, n_sections: int) -> Tensor:
    """How much of each section lies before a point: 1 before section j, X_tilde in it, 0 after it.

    Args:
        X_tilde: (..., k) normalised abscissa.
        j: (..., k) int64 zero-based section index.
        n_sections: Number of sections n_b.

    Returns:
        (..., k, n_b).
    """
    section = torch.arange(n_sections, device=j.device)
    index = j.unsqueeze(-1)
    inside = torch.where(section == index, X_tilde.unsqueeze(-1), 0.0)
    return torch.where(section < index, 1.0, inside).to(X_tilde.dtype)
