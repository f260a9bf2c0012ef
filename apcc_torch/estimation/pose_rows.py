"""What sensors' poses, and tendons, tell of an arm's shape."""

from __future__ import annotations

import torch
from torch import Tensor

from apcc_torch.errors import ValueRangeError
from apcc_torch.lie import so3
from apcc_torch.model.kinematic_model import Placed
from apcc_torch.modes import holds
from apcc_torch.settings import Setting, aligned
from apcc_torch.shapes import check_tensor


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


def tendon_weights(tendon_covariance: Tensor, n_a: int) -> Tensor:
    """What `tendon_rows` weighs the errors of n_a tendons with (..., 2, n_a, n_a), 1/m: together, and each alone.

    Args:
        tendon_covariance: (..., n_a, n_a) of the errors, m^2.
        n_a: Number of tendons.

    Raises:
        ShapeError: It is of another number of tendons.
        ValueRangeError: It is not positive definite.
    """
    covariance = check_tensor("tendon_covariance", tendon_covariance, (n_a, n_a))
    factor, failed = torch.linalg.cholesky_ex(covariance)
    if not holds(failed == 0) or not holds(torch.isclose(covariance, covariance.mT)):
        raise ValueRangeError("tendon_covariance must be finite, symmetric and positive definite")
    eye = torch.eye(n_a, dtype=covariance.dtype, device=covariance.device)
    together = torch.linalg.solve_triangular(factor, eye.expand_as(factor), upper=False)
    alone = torch.diag_embed(covariance.diagonal(dim1=-2, dim2=-1).rsqrt())
    return torch.stack((together, alone), dim=-3)


def tendon_rows(
    q: Tensor, B: Tensor, y: Tensor, noise: Setting, weights: Tensor | None = None
) -> tuple[Tensor, Tensor]:
    """What tendons' length changes leave of a shape, over its standard deviation, and the derivative of the shape's.

    Args:
        q: (..., n).
        B: (..., n, n_a) of the tendons.
        y: (..., n_a) measured, m, not finite where unknown.
        noise: m, of each alone; not used with weights.
        weights: (..., 2, n_a, n_a) from `tendon_weights`. Where a tendon is unknown, the others count each alone.

    Returns:
        r (..., n_a) and J (..., n_a, n).
    """
    off = y - (B.mT @ q.unsqueeze(-1)).squeeze(-1)
    known = torch.isfinite(off)
    off = torch.where(known, off, 0.0)
    if weights is None:
        scale = known.to(q) / aligned(noise, 1)
        return off * scale, B.mT * scale.unsqueeze(-1)
    together, alone = weights.unbind(-3)
    weight = torch.where(known.all(-1)[..., None, None], together, alone * known.unsqueeze(-1))
    return (weight @ off.unsqueeze(-1)).squeeze(-1), weight @ B.mT
