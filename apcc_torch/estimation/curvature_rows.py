"""What gratings along an arm tell of its shape: curvature in two axes."""

from __future__ import annotations

import torch
from torch import Tensor

from apcc_torch.settings import Setting, aligned


def curvature_rows(
    q: Tensor, lengths: Tensor, weights: Tensor, measured: Tensor, noise: Setting
) -> tuple[Tensor, Tensor]:
    """What measured curvature leaves of a shape, over its standard deviation, and the derivative of the shape's.

    Args:
        q: (..., n) of pieces of constant curvature.
        lengths: (..., n_p) their rest lengths, m.
        weights: (..., n_c, n_p) of the pieces' curvature at the places.
        measured: (..., n_c, 2) 1/m, not finite where it is not known.
        noise: 1/m.

    Returns:
        r (..., 2 n_c) and J (..., 2 n_c, n), place by place, x before y.
    """
    bend, stretched = q.unflatten(-1, (-1, 3))[..., :2], lengths + q[..., 2::3]  # (..., n_p, 2), (..., n_p)
    curvature = bend / stretched.unsqueeze(-1)
    off = measured - weights @ curvature
    known = torch.isfinite(off)
    scale = known.to(q) / aligned(noise, 2)
    # Of a piece's curvature by its own bend x, bend y and elongation: (..., n_p, 2, 3).
    own = torch.cat((torch.eye(2).to(q).expand(*curvature.shape, 2), -curvature.unsqueeze(-1)), dim=-1)
    own = own / stretched[..., None, None]
    J = (weights[..., None, :, None] * own.movedim(-3, -2).unsqueeze(-4)).flatten(-2)  # (..., n_c, 2, n_p 3)
    return (torch.where(known, off, 0.0) * scale).flatten(-2), (J * scale.unsqueeze(-1)).flatten(-3, -2)
