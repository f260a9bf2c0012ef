"""What sensors' poses, and tendons, tell of an arm's shape."""

from __future__ import annotations

import torch
from torch import Tensor

from apcc_torch.lie import so3
from apcc_torch.model.kinematic_model import Placed
from apcc_torch.settings import Setting, aligned


def pose_rows(
    chain: Placed,
    body: Tensor,
    T: Tensor,
    usable: Tensor,
    oriented: Tensor,
    position_noise: Setting,
    angular_noise: Setting,
) -> tuple[Tensor, Tensor]:
    """What k sensors leave of a shape, over its standard deviation, and the derivative of the shape's.

    Args:
        chain: The arm up to the sensors.
        body: (..., k, 6, n) body Jacobians there.
        T: (..., k, 4, 4) measured poses, finite where they count.
        usable, oriented: (..., k) bool, positions and orientations that count.
        position_noise, angular_noise: m and rad.

    Returns:
        r (..., 6 k) and J (..., 6 k, n), sensor by sensor, the angular part before the linear one.
    """
    into_body = chain.rotation.mT
    offset = torch.where(usable.unsqueeze(-1), T[..., :3, 3] - chain.tip, 0.0)
    turn = into_body @ torch.where(oriented[..., None, None], T[..., :3, :3], chain.rotation)
    linear, angular = (into_body @ offset.unsqueeze(-1)).squeeze(-1), so3.log(turn)
    weights = torch.broadcast_tensors(
        oriented.to(body) / aligned(angular_noise, 1), usable.to(body) / aligned(position_noise, 1)
    )
    weight = torch.stack(weights, dim=-1).unsqueeze(-1).expand(*usable.shape, 2, 3).flatten(-2)
    r = (torch.cat((angular, linear), dim=-1) * weight).flatten(-2)
    return r, (body * weight.unsqueeze(-1)).flatten(-3, -2)


def tendon_rows(q: Tensor, B: Tensor, y: Tensor, noise: Setting) -> tuple[Tensor, Tensor]:
    """What tendons' length changes leave of a shape, over its standard deviation, and the derivative of the shape's.

    Args:
        q: (..., n).
        B: (..., n, n_a) of the tendons.
        y: (..., n_a) measured, m, not finite where unknown.
        noise: m.

    Returns:
        r (..., n_a) and J (..., n_a, n).
    """
    off = y - (B.mT @ q.unsqueeze(-1)).squeeze(-1)
    known = torch.isfinite(off)
    scale = known.to(q) / aligned(noise, 1)
    return torch.where(known, off, 0.0) * scale, B.mT * scale.unsqueeze(-1)
