"""The paper's measures of how well a model matches an arm, and how well an arm does its task."""

from __future__ import annotations

import torch
from torch import Tensor

from apcc_torch.model.backbone import PCCBackbone
from apcc_torch.shapes import check_same, check_tensor

SHAPE_POINTS = 500
"""N of Eq. (52)."""


def shape_error(p_true: Tensor, p_approx: Tensor) -> Tensor:
    """Mean distance (...) m of corresponding backbone points. Eq. (52) [Dalenberg].

    Args:
        p_true: (..., N, 3) points along the real backbone, m.
        p_approx: (..., N, 3) points along the model's.

    Raises:
        ShapeError, DtypeError: The arguments do not fit each other.
    """
    check_tensor("p_true", p_true, (None, 3))
    check_tensor("p_approx", p_approx, (p_true.shape[-2], 3))
    check_same(p_true=p_true, p_approx=p_approx)
    return (p_true - p_approx).norm(dim=-1).mean(-1)  # Eq. (52)


def backbone_error(
    true: PCCBackbone,
    q_true: Tensor,
    L0_true: Tensor,
    model: PCCBackbone,
    q: Tensor,
    L0: Tensor,
    N: int = SHAPE_POINTS,
    chunk_rows: int = 4096,
) -> Tensor:
    """`shape_error` of two arms for whole logs, in chunks of rows so that memory stays bounded.

    Args:
        true: The real arm's backbone.
        q_true: (..., n_t) its configurations.
        L0_true: (..., n_b_t) its rest lengths, m.
        model: The model's backbone.
        q: (..., n) the model's configurations.
        L0: (..., n_b) its rest lengths, m.
        N: Points along each backbone.
        chunk_rows: Rows computed at a time.

    Returns:
        (...) m.
    """
    batch = torch.broadcast_shapes(q_true.shape[:-1], L0_true.shape[:-1], q.shape[:-1], L0.shape[:-1])
    flat = [v.expand(*batch, v.shape[-1]).reshape(-1, v.shape[-1]) for v in (q_true, L0_true, q, L0)]
    errors = [
        shape_error(true.points(a, b, N), model.points(c, d, N))
        for a, b, c, d in zip(*(v.split(chunk_rows) for v in flat), strict=True)
    ]
    return torch.cat(errors).reshape(batch)


def mapping_error(model: PCCBackbone, q_d: Tensor, pi_hat: Tensor, x_measured: Tensor) -> Tensor:
    """Distance (...) m between where q_d should put the tip and where it is. Eq. (53) [Dalenberg].

    Args:
        model: The model.
        q_d: (..., n) desired configuration.
        pi_hat: (..., n_b) m.
        x_measured: (..., 3) measured tip, m.
    """
    return (model.tip(q_d, pi_hat) - x_measured).norm(dim=-1)  # Eq. (53)
