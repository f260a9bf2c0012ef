"""The paper's measures of how well a model matches an arm, and how well an arm does its task."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from apcc_torch.lie import so3
from apcc_torch.model.abscissae import decouple
from apcc_torch.model.kinematic_model import KinematicModel
from apcc_torch.shapes import broadcast, check_same, check_tensor

SHAPE_POINTS = 500
"""N of Eq. (52)."""


def shape_error(p_true: Tensor, p_approx: Tensor) -> Tensor:
    """Mean distance (...) m of corresponding backbone points. Eq. (52) [Dalenberg].

    Args:
        p_true: (..., N, 3) points along the real backbone, m.
        p_approx: (..., N, 3) points along the model's.

    Raises:
        ShapeError, DtypeError: The arguments do not fit each other.

    Example:
        >>> line = torch.linspace(0.0, 0.4, 5).unsqueeze(-1) * torch.tensor([0.0, 0.0, 1.0])
        >>> shape_error(line, line + torch.tensor([0.003, 0.0, 0.004]))
        tensor(0.0050)
    """
    check_tensor("p_true", p_true, (None, 3))
    check_tensor("p_approx", p_approx, (p_true.shape[-2], 3))
    check_same(p_true=p_true, p_approx=p_approx)
    return (p_true - p_approx).norm(dim=-1).mean(-1)  # Eq. (52)


def backbone_error(
    true: KinematicModel,
    q_true: Tensor,
    L0_true: Tensor,
    model: KinematicModel,
    q: Tensor,
    L0: Tensor,
    N: int = SHAPE_POINTS,
    chunk_rows: int = 64,
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
        chunk_rows: Rows computed at a time; few enough that they stay in a processor's cache.

    Returns:
        (...) m.

    Example:
        >>> backbone, L0 = PCCBackbone(2), torch.tensor([0.2, 0.25])
        >>> backbone_error(backbone, torch.zeros(6), L0, backbone, torch.zeros(6), L0 + 0.01)
        tensor(0.0100)
    """
    batch = broadcast(q_true.shape[:-1], L0_true.shape[:-1], q.shape[:-1], L0.shape[:-1])
    flat = [v.expand(*batch, v.shape[-1]).reshape(-1, v.shape[-1]) for v in (q_true, L0_true, q, L0)]
    share = torch.linspace(0.0, 1.0, N, dtype=q.dtype, device=q.device)
    errors = [
        _distance(true.curve(a, b, share), model.curve(c, d, share)).mean(-1)  # Eq. (52)
        for a, b, c, d in zip(*(v.split(chunk_rows) for v in flat), strict=True)
    ]
    return torch.cat(errors).reshape(batch)


def _distance(p: Tensor, other: Tensor) -> Tensor:
    """Distances (R, N) m of corresponding points (R, 3, N); a norm over a dimension that is not last is far slower."""
    x, y, z = (p - other).unbind(-2)
    return torch.addcmul(torch.addcmul(x * x, y, y), z, z).sqrt()


def mapping_error(model: KinematicModel, q_d: Tensor, pi_hat: Tensor, x_measured: Tensor) -> Tensor:
    """Distance (...) m between where q_d should put the tip and where it is. Eq. (53) [Dalenberg].

    Args:
        model: The model.
        q_d: (..., n) desired configuration.
        pi_hat: (..., n_b) m.
        x_measured: (..., 3) measured tip, m.

    Example:
        >>> backbone, L0 = PCCBackbone(2), torch.tensor([0.2, 0.25])
        >>> mapping_error(backbone, torch.zeros(6), L0, torch.tensor([0.0, 0.003, 0.454]))
        tensor(0.0050)
    """
    return (model.tip(q_d, pi_hat) - x_measured).norm(dim=-1)  # Eq. (53)


class VelocityQuality(NamedTuple):
    """What a measured velocity is worth: lag (...) s behind the true one, and noise (...) m/s, RMS of what is left."""

    lag: Tensor
    noise: Tensor


def velocity_quality(seen: Tensor, true: Tensor, dt: float) -> VelocityQuality:
    """Lag and noise of a velocity, from seen(t) = a true(t) - a lag d(true)/dt + noise by least squares.

    The factor a takes up what a wrong model makes of a velocity: neither lag nor noise.

    Args:
        seen: (T, ..., 3) measured velocity, m/s.
        true: (T, ..., 3) the true one.
        dt: Step, s.

    Example:
        >>> time = 0.01 * torch.arange(400).double()
        >>> true, late = (torch.stack([torch.sin(t), torch.cos(t), t], -1) for t in (time, time - 0.03))
        >>> velocity_quality(late, true, 0.01).lag
        tensor(0.0300, dtype=torch.float64)
    """
    check_tensor("seen", seen, (3,))
    check_tensor("true", true, (3,))
    check_same(seen=seen, true=true)
    rate = torch.gradient(true, spacing=dt, dim=0)[0]
    columns = torch.stack((true, rate), dim=-1).movedim(0, -3).flatten(-3, -2)  # (..., 3 T, 2)
    b = seen.movedim(0, -2).flatten(-2).unsqueeze(-1)
    fit = torch.linalg.lstsq(columns, b).solution
    left = (b - columns @ fit).squeeze(-1)
    factor, delayed = fit.squeeze(-1).unbind(-1)
    return VelocityQuality(-delayed / factor, 3**0.5 * left.square().mean(-1).sqrt())


def orientation_error(model: KinematicModel, q: Tensor, pi_hat: Tensor, abscissae: Tensor, rotation: Tensor) -> Tensor:
    """Angles (..., k) rad between the model's orientations at the sensors and the true ones, measured or not.

    Args:
        model: The model.
        q: (..., n) its configuration.
        pi_hat: (..., n_b) m.
        abscissae: (k,) of the sensors, m.
        rotation: (..., k, 3, 3) true orientations.

    Example:
        >>> backbone, L0 = PCCBackbone(1), torch.tensor([0.2])
        >>> orientation_error(backbone, torch.tensor([0.3, 0.0, 0.0]), L0, L0, torch.eye(3).expand(1, 3, 3))
        tensor([0.3000])
    """
    pi_hat = pi_hat.expand(*q.shape[:-1], pi_hat.shape[-1])
    T = model.pose(q, pi_hat, *decouple(abscissae.to(q), pi_hat))
    return so3.log(T[..., :3, :3].mT @ rotation).norm(dim=-1)
