"""Rotations SO(3): hat, vee, exp, log and the Jacobians of exp, smooth at the identity and right up to half a turn.

A rotation vector w (..., 3), rad, is the axis times the angle D; W = hat(w) is its cross product as a matrix. Every
power series in W that occurs here reduces to i I + a W + b w w^T whose coefficients are Stumpff functions of D^2:

    exp(w) = c_0 I + c_1 W + c_2 w w^T,   J_l(w) = c_1 I + c_2 W + c_3 w w^T,
    J_l(w)^-1 = (1 - e D^2) I - W / 2 + e w w^T,   e = (c_3 - 2 c_4) / (2 c_2).

J_l turns the rate of w into the angular velocity in the fixed axes, hat(J_l wdot) = Rdot R^T, and J_r = J_l^T into the
one in the body's axes. The adjoint of SO(3) is R itself.
"""

from __future__ import annotations

from math import pi

import torch
from torch import Tensor

from apcc_torch.lie.stumpff import stumpff
from apcc_torch.modes import known
from apcc_torch.shapes import check_tensor

__all__ = [
    "exp",
    "hat",
    "left_jacobian",
    "left_jacobian_inverse",
    "log",
    "right_jacobian",
    "right_jacobian_inverse",
    "vee",
]

# `log` uses its power series where |v|^2 = (4 sin(D / 2) cos(D / 2))^2 is below this, D < 0.045 rad: four terms leave
# less than 1e-17 of the angle there. Above, atan2 is used; its second derivatives have lost a digit by then, not more.
_LOG_SERIES_BELOW = 8e-3


def hat(w: Tensor) -> Tensor:
    """The matrix (..., 3, 3) of the cross product with w: hat(w) @ v = w x v.

    Args:
        w: (..., 3).

    Raises:
        ShapeError: w does not end in 3.

    Example:
        >>> so3.hat(torch.tensor([1.0, 2.0, 3.0]))
        tensor([[ 0., -3.,  2.],
                [ 3.,  0., -1.],
                [-2.,  1.,  0.]])
    """
    x, y, z = check_tensor("w", w, (3,)).unbind(-1)
    o = torch.zeros_like(x)
    return torch.stack((o, -z, y, z, o, -x, -y, x, o), dim=-1).unflatten(-1, (3, 3))


def vee(matrix: Tensor) -> Tensor:
    """The vector (..., 3) of a matrix's skew-symmetric part; the inverse of `hat` on skew-symmetric matrices.

    Args:
        matrix: (..., 3, 3).

    Raises:
        ShapeError: matrix does not end in (3, 3).

    Example:
        >>> so3.vee(so3.hat(torch.tensor([1.0, 2.0, 3.0])))
        tensor([1., 2., 3.])
    """
    return 0.5 * _twice_vee(check_tensor("matrix", matrix, (3, 3)))


def squared_angle(w: Tensor) -> Tensor:
    """D^2 (..., 1), rad^2, of a rotation vector w (..., 3).

    The last dimension stays, so that its functions multiply vectors as they are. It also keeps float32 apart from a
    habit of torch, whose forward mode turns tangents of tensors without dimensions into float64.
    """
    return (w * w).sum(-1, keepdim=True)


def symmetric_plus_cross(w: Tensor, i: Tensor, a: Tensor, b: Tensor) -> Tensor:
    """i I + a hat(w) + b w w^T, (..., 3, 3).

    Args:
        w: (..., 3).
        i: (..., 1) coefficient of the identity.
        a: (..., 1) coefficient of the cross product.
        b: (..., 1) coefficient of the outer product.
    """
    x, y, z = w.split(1, dim=-1)
    xa, ya, za = (w * a).split(1, dim=-1)
    xb, yb, zb = (w * b).split(1, dim=-1)
    xy, xz, yz = x * yb, x * zb, y * zb
    entries = (i + x * xb, xy - za, xz + ya, xy + za, i + y * yb, yz - xa, xz - ya, yz + xa, i + z * zb)
    return torch.cat(entries, dim=-1).unflatten(-1, (3, 3))


def exp(w: Tensor) -> Tensor:
    """The rotation matrix (..., 3, 3) of a rotation vector.

    Args:
        w: (..., 3) rad, of any length.

    Raises:
        ShapeError: w does not end in 3.

    Example:
        >>> so3.exp(torch.tensor([0.0, 0.0, 0.5])) @ torch.tensor([1.0, 1.0, 1.0])
        tensor([0.3982, 1.3570, 1.0000])
    """
    c = stumpff(squared_angle(check_tensor("w", w, (3,))))
    return symmetric_plus_cross(w, c.c0, c.c1, c.c2)


def log(rotation: Tensor) -> Tensor:
    """The rotation vector (..., 3), rad, of a rotation matrix, no longer than pi.

    Its derivatives are right to second order at the identity too. At an angle of exactly pi both w and -w are
    logarithms: the one whose largest component is positive is returned, and the derivatives are those of its side.

    Args:
        rotation: (..., 3, 3).

    Raises:
        ShapeError: rotation does not end in (3, 3).

    Example:
        >>> so3.log(so3.exp(torch.tensor([0.1, 0.2, 0.3])))
        tensor([0.1000, 0.2000, 0.3000])
    """
    return 2.0 * half_log(check_tensor("rotation", rotation, (3, 3)))[0]


def half_log(rotation: Tensor) -> tuple[Tensor, Tensor]:
    """Half the logarithm, h = w / 2 (..., 3), rad, and with it k = 4 e(D^2) (..., 1), which costs next to nothing here.

    With hat(h) = H the inverse Jacobian is J_l(w)^-1 = I - H + k H^2; e is the `inverse_coefficient`. The quaternion
    (w, v) gives |h| = atan(|v| / w) at any scale, so it is never normalised.

    Args:
        rotation: (..., 3, 3); its shape is not checked here.
    """
    v, trace = _twice_vee(rotation), rotation.diagonal(dim1=-2, dim2=-1).sum(-1, keepdim=True)
    w, n2 = 1.0 + trace, _squared(v)
    # Below 90 degrees (w, v) is itself the row that is wanted; small turns, the usual ones, need nothing more.
    plain = trace > 0.0
    all_small = known(plain & (n2 < _LOG_SERIES_BELOW))
    if not all_small:
        row_w, row_v = quaternion_multiple(rotation, v, trace).split_with_sizes((1, 3), dim=-1)
        w, v = torch.where(plain, w, row_w), torch.where(plain, v, row_v)
        n2 = _squared(v)

    # With q = tan^2|h|: |h| cot|h| = atan(sqrt(q)) / sqrt(q) = 1 - q (1/3 - q/5 + q^2/7 - q^3/9 + ...).
    inverse = w.clamp(min=1.0).reciprocal()  # w is nearly 4 where the series is used
    inverse2 = inverse * inverse
    q = (n2 if all_small else n2.clamp(max=_LOG_SERIES_BELOW)) * inverse2
    series = torch.addcmul(torch.rsub(q, 1 / 3, alpha=1 / 5), q * q, torch.rsub(q, 1 / 7, alpha=1 / 9))
    factor = torch.addcmul(inverse, inverse * q, series, value=-1.0)
    rest = series * inverse2
    if not all_small:
        small = n2 < _LOG_SERIES_BELOW
        # Clamped before and selected after: neither branch is ever evaluated where its derivative would be NaN.
        n2_large = n2.clamp(min=_LOG_SERIES_BELOW)
        n = torch.sqrt(n2_large)
        angle = torch.atan2(n, w)
        factor_large = torch.where(w < 0.0, angle - pi, angle) / n  # |h| / |v|, the short way round
        rest_large = torch.rsub(factor_large * w, 1.0) / n2_large  # (1 - |h| cot|h|) / |v|^2
        factor, rest = torch.where(small, factor, factor_large), torch.where(small, rest, rest_large)
    return factor * v, rest / (factor * factor)


def _squared(v: Tensor) -> Tensor:
    """|v|^2 (..., 1)."""
    return (v * v).sum(-1, keepdim=True)


def _twice_vee(rotation: Tensor) -> Tensor:
    """R - R^T as a vector (..., 3), twice its `vee`."""
    _, m01, m02, m10, _, m12, m20, m21, _ = rotation.flatten(-2).unbind(-1)
    return torch.stack((m21 - m12, m02 - m20, m10 - m01), dim=-1)


def quaternion_multiple(rotation: Tensor, v: Tensor, trace: Tensor) -> Tensor:
    """A multiple (..., 4) of the unit quaternion q = (w, x, y, z) of a rotation R of trace t.

    4 q q^T = [[1 + t, v^T], [v, R + R^T + (1 - t) I]] with v twice the `vee` of R. Its row with the largest diagonal
    entry is returned; that entry is at least 1, so no small number is ever divided by.
    """
    eye = torch.eye(3, dtype=rotation.dtype, device=rotation.device)
    trace = trace.unsqueeze(-1)
    block = torch.addcmul(rotation + rotation.mT, eye, torch.rsub(trace, 1.0))
    first = torch.cat((1.0 + trace, v.unsqueeze(-2)), dim=-1)
    rows = torch.cat((first, torch.cat((v.unsqueeze(-1), block), dim=-1)), dim=-2)
    largest = rows.diagonal(dim1=-2, dim2=-1).argmax(-1, keepdim=True)
    return rows.gather(-2, largest.unsqueeze(-1).expand(*largest.shape, 4)).squeeze(-2)


def inverse_coefficient(squared: Tensor) -> Tensor:
    """e = (1 - (D / 2) cot(D / 2)) / D^2 = 1 / 12 + D^2 / 720 + ..., the coefficient of the inverse Jacobian.

    With the Stumpff functions of D^2 / 4 it is (c_2 - c_3) / (4 c_1): smooth at 0, and as precise as it can be up to
    its pole at D = 2 pi.

    Args:
        squared: (...) D^2, rad^2, in [0, 4 pi^2).
    """
    c = stumpff(0.25 * squared)
    return 0.25 * (c.c2 - c.c3) / c.c1


def left_jacobian(w: Tensor) -> Tensor:
    """J_l (..., 3, 3): the angular velocity in the fixed axes is J_l(w) wdot.

    Args:
        w: (..., 3) rad.

    Raises:
        ShapeError: w does not end in 3.

    Example:
        >>> w, dw = torch.tensor([0.3, -0.2, 0.5]).double(), 1e-6 * torch.tensor([1.0, 2.0, -1.0]).double()
        >>> torch.allclose(so3.exp(w + dw), so3.exp(so3.left_jacobian(w) @ dw) @ so3.exp(w), rtol=0.0, atol=1e-11)
        True
    """
    c = stumpff(squared_angle(check_tensor("w", w, (3,))))
    return symmetric_plus_cross(w, c.c1, c.c2, c.c3)


def right_jacobian(w: Tensor) -> Tensor:
    """J_r(w) = J_l(-w) (..., 3, 3): the angular velocity in the body's axes is J_r(w) wdot; see `left_jacobian`.

    Example:
        >>> w, dw = torch.tensor([0.3, -0.2, 0.5]).double(), 1e-6 * torch.tensor([1.0, 2.0, -1.0]).double()
        >>> torch.allclose(so3.exp(w + dw), so3.exp(w) @ so3.exp(so3.right_jacobian(w) @ dw), rtol=0.0, atol=1e-11)
        True
    """
    return left_jacobian(-check_tensor("w", w, (3,)))


def left_jacobian_inverse(w: Tensor) -> Tensor:
    """The inverse (..., 3, 3) of `left_jacobian`, for angles below 2 pi.

    Args:
        w: (..., 3) rad.

    Raises:
        ShapeError: w does not end in 3.

    Example:
        >>> w = torch.tensor([0.3, -0.2, 0.5])
        >>> torch.allclose(so3.left_jacobian_inverse(w) @ so3.left_jacobian(w), torch.eye(3), atol=1e-6)
        True
    """
    squared = squared_angle(check_tensor("w", w, (3,)))
    e = inverse_coefficient(squared)
    return symmetric_plus_cross(w, 1.0 - e * squared, torch.full_like(e, -0.5), e)


def right_jacobian_inverse(w: Tensor) -> Tensor:
    """The inverse (..., 3, 3) of `right_jacobian`, for angles below 2 pi; see `left_jacobian_inverse`.

    Example:
        >>> w = torch.tensor([0.3, -0.2, 0.5])
        >>> torch.allclose(so3.right_jacobian_inverse(w) @ so3.right_jacobian(w), torch.eye(3), atol=1e-6)
        True
    """
    return left_jacobian_inverse(-check_tensor("w", w, (3,)))
