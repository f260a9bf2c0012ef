"""Positions along many arms, fast: what every step of every environment needs."""

from __future__ import annotations

import torch
from torch import Tensor

from apcc_torch.model.inertia import base_frames, bending, rotate


def powers(fractions: tuple[float, ...], like: Tensor) -> Tensor:
    """(6, K) powers of material fractions of a section, as `inertia.bending` wants them; the last fraction is 1."""
    s = torch.tensor(fractions, dtype=like.dtype, device=like.device)
    return torch.stack([s**k for k in range(1, 7)])


def backbone_points(q: Tensor, lengths: Tensor, base: Tensor, powers: Tensor) -> Tensor:
    """Material points at the same K fractions of every section, from base to tip, (N, K n, 3) m, world frame.

    The same positions as `PCCBackbone.pose`, in the layout of `inertia`, without what only Jacobians need.

    Args:
        q: (N, 3 n) configuration.
        lengths: (N, n) rest lengths, m.
        base: (3, 3) arm base to world.
        powers: (6, K) from `powers`.
    """
    bend = bending(q.mT.contiguous(), lengths.mT.contiguous(), powers)
    beta, alpha = bend.radial[:2]
    across = bend.length * beta
    local = torch.stack((across * bend.x, across * bend.y, bend.length * alpha))
    steps = rotate(base_frames(bend, base.unsqueeze(-1)), local)  # (3, K, n, N), from each section's base
    whole = steps[:, -1]
    points = steps + (whole.cumsum(1) - whole).unsqueeze(1)
    return points.permute(3, 2, 1, 0).flatten(1, 2)
