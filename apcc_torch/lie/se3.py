"""Rigid motions SE(3): hat, vee, exp, log, inverse, adjoint and the Jacobians of exp, smooth at the identity.

A twist xi (..., 6) is angular first, then linear: (w, v), rad and m. A pose (..., 4, 4) is [[R, p], [0, 1]], p in m.
J_l turns the rate of xi into the spatial velocity, hat(J_l xidot) = Tdot T^-1, and J_r(xi) = J_l(-xi) into the body
velocity, hat(J_r xidot) = T^-1 Tdot.

An analytic function f of the 6x6 matrix ad(xi) = [[W, 0], [V, W]] is [[f(W), 0], [Q, f(W)]], where Q is the derivative
of f at W along V. That gives the 6x6 Jacobians from those of SO(3); Q is the matrix of that name in Barfoot's book.
"""

from __future__ import annotations

import torch
from torch import Tensor
from torch.nn.functional import pad

from apcc_torch.lie import so3
from apcc_torch.lie.stumpff import stumpff
from apcc_torch.modes import full_precision
from apcc_torch.shapes import batch_shape, check_tensor

__all__ = [
    "adjoint",
    "exp",
    "hat",
    "inverse",
    "left_jacobian",
    "left_jacobian_inverse",
    "log",
    "pose",
    "right_jacobian",
    "right_jacobian_inverse",
    "vee",
]


def hat(twist: Tensor) -> Tensor:
    """The matrix (..., 4, 4) [[hat(w), v], [0, 0]] of a twist.

    Args:
        twist: (..., 6) angular (rad), linear (m).

    Raises:
        ShapeError: twist does not end in 6.

    Example:
        >>> se3.hat(torch.tensor([0.0, 0.0, 1.0, 2.0, 3.0, 4.0]))
        tensor([[ 0., -1.,  0.,  2.],
                [ 1.,  0., -0.,  3.],
                [-0.,  0.,  0.,  4.],
                [ 0.,  0.,  0.,  0.]])
    """
    w, v = check_tensor("twist", twist, (6,)).split(3, dim=-1)
    return pad(torch.cat((so3.hat(w), v.unsqueeze(-1)), dim=-1), (0, 0, 0, 1))


def vee(matrix: Tensor) -> Tensor:
    """The twist (..., 6) of a matrix made by `hat`.

    Args:
        matrix: (..., 4, 4).

    Raises:
        ShapeError: matrix does not end in (4, 4).

    Example:
        >>> se3.vee(se3.hat(torch.tensor([0.0, 0.0, 1.0, 2.0, 3.0, 4.0])))
        tensor([0., 0., 1., 2., 3., 4.])
    """
    rotation, position = _parts(check_tensor("matrix", matrix, (4, 4)))
    return torch.cat((so3.vee(rotation), position), dim=-1)


def pose(rotation: Tensor, position: Tensor) -> Tensor:
    """The matrix (..., 4, 4) [[R, p], [0, 1]].

    Args:
        rotation: (..., 3, 3).
        position: (..., 3) m; leading dimensions broadcast with those of rotation.

    Raises:
        ShapeError: A trailing dimension is wrong, or the leading dimensions do not broadcast.

    Example:
        >>> se3.pose(torch.eye(3), torch.tensor([0.1, 0.2, 0.3]))
        tensor([[1.0000, 0.0000, 0.0000, 0.1000],
                [0.0000, 1.0000, 0.0000, 0.2000],
                [0.0000, 0.0000, 1.0000, 0.3000],
                [0.0000, 0.0000, 0.0000, 1.0000]])
    """
    check_tensor("rotation", rotation, (3, 3))
    check_tensor("position", position, (3,))
    if rotation.shape[:-2] != position.shape[:-1]:
        batch = batch_shape(rotation=(rotation, 2), position=(position, 1))
        rotation, position = rotation.expand(*batch, 3, 3), position.expand(*batch, 3)
    column = pad(position, (0, 1), value=1.0).unsqueeze(-1)
    return torch.cat((pad(rotation, (0, 0, 0, 1)), column), dim=-1)


def _parts(matrix: Tensor) -> tuple[Tensor, Tensor]:
    """The blocks (..., 3, 3) and (..., 3) of the upper rows of a (..., 4, 4) matrix."""
    rotation, column = matrix[..., :3, :].split_with_sizes((3, 1), dim=-1)
    return rotation, column.squeeze(-1)


def exp(twist: Tensor) -> Tensor:
    """The pose (..., 4, 4) reached by moving along a constant twist for one unit of time.

    Args:
        twist: (..., 6) angular (rad), linear (m).

    Raises:
        ShapeError: twist does not end in 6.

    Example:
        >>> se3.exp(torch.tensor([0.0, 0.0, pi / 2, 1.0, 0.0, 0.0]))[:3, 3]
        tensor([0.6366, 0.6366, 0.0000])
    """
    w, v = check_tensor("twist", twist, (6,)).split(3, dim=-1)
    c = stumpff(so3.squared_angle(w))
    rotation = so3.symmetric_plus_cross(w, c.c0, c.c1, c.c2)
    # p = J_l(w) v, with J_l = I + c_2 W + c_3 W^2.
    cross = torch.linalg.cross(w, v)
    position = v + c.c2 * cross + c.c3 * torch.linalg.cross(w, cross)
    return pose(rotation, position)


def log(transform: Tensor) -> Tensor:
    """The twist (..., 6), angular (rad) then linear (m), of a pose; its angle is at most pi.

    Its derivatives are right to second order at the identity too; at an angle of exactly pi see `so3.log`.

    Args:
        transform: (..., 4, 4).

    Raises:
        ShapeError: transform does not end in (4, 4).

    Example:
        >>> se3.log(se3.exp(torch.tensor([0.1, 0.2, 0.3, 1.0, 2.0, 3.0])))
        tensor([0.1000, 0.2000, 0.3000, 1.0000, 2.0000, 3.0000])
    """
    rotation, position = _parts(check_tensor("transform", transform, (4, 4)))
    return log_from_half(*so3.half_log(rotation), position)


def log_from_half(half: Tensor, k: Tensor, position: Tensor) -> Tensor:
    """The twist (..., 6) of the pose whose rotation has `so3.half_log` (half, k); shapes are not checked here.

    Args:
        half: (..., 3) rad.
        k: (..., 1).
        position: (..., 3) m.
    """
    # v = J_l(w)^-1 p, with J_l^-1 = I - H + k H^2.
    cross = torch.linalg.cross(half, position)
    v = torch.addcmul(position - cross, k, torch.linalg.cross(half, cross))
    return torch.cat((2.0 * half, v), dim=-1)


def left_jacobian_inverse_times(twist: Tensor, k: Tensor, columns: Tensor) -> Tensor:
    """J_l(twist)^-1 @ columns, (..., 6, n), without the matrix; shapes are not checked here.

    J_l^-1 is f(ad) for f(z) = 1 - z/2 + ... . With H and G the matrices of half the twist's angular and linear part,
    its diagonal block is f(W) = I - H + k H^2 and the block below is the derivative of f(W) along V,
    -G + k (H G + G H) + k' H^2, where k' = (h . g) ((1 - 3 k) / |h|^2 + k^2).

    Args:
        twist: (..., 6) angular (rad), linear (m), of an angle below 2 pi.
        k: (..., 1) of its `so3.half_log`.
        columns: (..., 6, n) twists side by side.
    """
    h, g = (0.5 * twist).unsqueeze(-1).split_with_sizes((3, 3), dim=-2)
    k = k.unsqueeze(-1)
    squared = (h * h).sum(-2, keepdim=True)
    # 1 - 3 k vanishes as |h|^2 / 15 does; what rounding leaves of the quotient meets H^2, which vanishes too.
    slope = torch.rsub(k, 1.0, alpha=3.0) / squared.clamp(min=torch.finfo(squared.dtype).tiny)
    slope = torch.addcmul(slope, k, k) * (h * g).sum(-2, keepdim=True)
    both = columns.unflatten(-2, (2, 3))
    h_both = h.unsqueeze(-3)
    once = torch.linalg.cross(h_both, both, dim=-2)
    twice = torch.linalg.cross(h_both, once, dim=-2)
    angular, linear = torch.addcmul(both - once, k.unsqueeze(-3), twice).unbind(-3)
    across = torch.linalg.cross(g, columns[..., :3, :], dim=-2)
    mixed = torch.linalg.cross(h, across, dim=-2) + torch.linalg.cross(g, once[..., 0, :, :], dim=-2)
    below = torch.addcmul(torch.addcmul(linear - across, k, mixed), slope, twice[..., 0, :, :])
    return torch.cat((angular, below), dim=-2)


def inverse(transform: Tensor) -> Tensor:
    """The inverse pose (..., 4, 4), [[R^T, -R^T p], [0, 1]].

    Args:
        transform: (..., 4, 4).

    Raises:
        ShapeError: transform does not end in (4, 4).

    Example:
        >>> T = se3.exp(torch.tensor([0.1, 0.2, 0.3, 1.0, 2.0, 3.0]))
        >>> torch.allclose(se3.inverse(T) @ T, torch.eye(4), atol=1e-6)
        True
    """
    rotation, position = _parts(check_tensor("transform", transform, (4, 4)))
    return pose(rotation.mT, -(rotation * position.unsqueeze(-1)).sum(-2))


@full_precision
def adjoint(transform: Tensor) -> Tensor:
    """Ad_T (..., 6, 6) = [[R, 0], [hat(p) R, R]]: T exp(xi) T^-1 = exp(Ad_T xi).

    Args:
        transform: (..., 4, 4).

    Raises:
        ShapeError: transform does not end in (4, 4).

    Example:
        >>> T = se3.pose(torch.eye(3), torch.tensor([0.5, 0.0, 0.0]))
        >>> se3.adjoint(T) @ torch.tensor([0.0, 0.0, 1.0, 0.0, 0.0, 0.0])
        tensor([ 0.0000,  0.0000,  1.0000,  0.0000, -0.5000,  0.0000])
    """
    rotation, position = _parts(check_tensor("transform", transform, (4, 4)))
    return _block_triangular(rotation, so3.hat(position) @ rotation)


def _block_triangular(diagonal: Tensor, lower: Tensor) -> Tensor:
    """[[diagonal, 0], [lower, diagonal]], (..., 6, 6) from (..., 3, 3) blocks."""
    return torch.cat((pad(diagonal, (0, 3)), torch.cat((lower, diagonal), dim=-1)), dim=-2)


def left_jacobian(twist: Tensor) -> Tensor:
    """J_l (..., 6, 6): the spatial velocity is J_l(xi) xidot, angular rows first.

    Args:
        twist: (..., 6) angular (rad), linear (m).

    Raises:
        ShapeError: twist does not end in 6.

    Example:
        >>> x, dx = 0.3 * torch.ones(6).double(), 1e-6 * torch.arange(6.0).double()
        >>> torch.allclose(se3.exp(x + dx), se3.exp(se3.left_jacobian(x) @ dx) @ se3.exp(x), rtol=0.0, atol=1e-10)
        True
    """
    w, v = check_tensor("twist", twist, (6,)).split(3, dim=-1)
    c = stumpff(so3.squared_angle(w))
    diagonal = so3.symmetric_plus_cross(w, c.c1, c.c2, c.c3)
    # Q is the derivative of c_1 I + c_2 W + c_3 w w^T along v; c_m changes by (w . v) (m c_{m+2} - c_{m+1}).
    p = (w * v).sum(-1, keepdim=True)
    along = so3.symmetric_plus_cross(w, p * (c.c3 - c.c2), p * (2.0 * c.c4 - c.c3), p * (3.0 * c.c5 - c.c4))
    outer = (c.c3 * w).unsqueeze(-1) * v.unsqueeze(-2)
    lower = along + so3.hat(c.c2 * v) + outer + outer.mT
    return _block_triangular(diagonal, lower)


def right_jacobian(twist: Tensor) -> Tensor:
    """J_r(xi) = J_l(-xi) (..., 6, 6): the body velocity is J_r(xi) xidot; see `left_jacobian`.

    Example:
        >>> x, dx = 0.3 * torch.ones(6).double(), 1e-6 * torch.arange(6.0).double()
        >>> torch.allclose(se3.exp(x + dx), se3.exp(x) @ se3.exp(se3.right_jacobian(x) @ dx), rtol=0.0, atol=1e-10)
        True
    """
    return left_jacobian(-check_tensor("twist", twist, (6,)))


@full_precision
def left_jacobian_inverse(twist: Tensor) -> Tensor:
    """The inverse (..., 6, 6) of `left_jacobian`, for angles below 2 pi.

    Args:
        twist: (..., 6) angular (rad), linear (m).

    Raises:
        ShapeError: twist does not end in 6.

    Example:
        >>> x = torch.tensor([0.1, 0.2, 0.3, 1.0, 2.0, 3.0])
        >>> torch.allclose(se3.left_jacobian_inverse(x) @ se3.left_jacobian(x), torch.eye(6), atol=1e-6)
        True
    """
    jacobian = left_jacobian(twist)
    inverse_block = so3.left_jacobian_inverse(twist[..., :3])
    return _block_triangular(inverse_block, -(inverse_block @ jacobian[..., 3:, :3] @ inverse_block))


def right_jacobian_inverse(twist: Tensor) -> Tensor:
    """The inverse (..., 6, 6) of `right_jacobian`, for angles below 2 pi; see `left_jacobian_inverse`.

    Example:
        >>> x = torch.tensor([0.1, 0.2, 0.3, 1.0, 2.0, 3.0])
        >>> torch.allclose(se3.right_jacobian_inverse(x) @ se3.right_jacobian(x), torch.eye(6), atol=1e-6)
        True
    """
    return left_jacobian_inverse(-check_tensor("twist", twist, (6,)))
