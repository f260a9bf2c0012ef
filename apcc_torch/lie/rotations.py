"""Rotations as measurements bring them: from quaternions, their angle from each other, and their mean."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from apcc_torch.lie import so3
from apcc_torch.modes import full_precision
from apcc_torch.shapes import check_tensor

_OUTLIER = 3.0
"""Rotations this many times the median angle off the mean are left out of it."""


def quaternion_rotation(quaternion: Tensor) -> Tensor:
    """The matrix (..., 3, 3) of a quaternion (x, y, z, w), times its squared length.

    It is a rotation for a unit quaternion only: one of another length, zero too, is seen in the matrix.

    Args:
        quaternion: (..., 4).

    Example:
        >>> quaternion_rotation(torch.tensor([0.0, 0.0, 1.0, 0.0]))
        tensor([[-1.,  0.,  0.],
                [ 0., -1.,  0.],
                [ 0.,  0.,  1.]])
    """
    x, y, z, w = check_tensor("quaternion", quaternion, (4,)).unbind(-1)
    xx, yy, zz, ww = x * x, y * y, z * z, w * w
    rows = (
        *(ww + xx - yy - zz, 2 * (x * y - w * z), 2 * (x * z + w * y)),
        *(2 * (x * y + w * z), ww - xx + yy - zz, 2 * (y * z - w * x)),
        *(2 * (x * z - w * y), 2 * (y * z + w * x), ww - xx - yy + zz),
    )
    return torch.stack(rows, dim=-1).unflatten(-1, (3, 3))


def rotation_quaternion(rotation: Tensor) -> Tensor:
    """The unit quaternion (x, y, z, w) (..., 4) of a rotation (..., 3, 3), w not negative; of half a turn, one of two.

    Example:
        >>> rotation_quaternion(quaternion_rotation(torch.tensor([-0.5, 0.5, -0.5, -0.5])))
        tensor([ 0.5000, -0.5000,  0.5000,  0.5000])
    """
    check_tensor("rotation", rotation, (3, 3))
    trace = rotation.diagonal(dim1=-2, dim2=-1).sum(-1, keepdim=True)
    multiple = so3.quaternion_multiple(rotation, 2.0 * so3.vee(rotation), trace)
    w, v = multiple.split_with_sizes((1, 3), dim=-1)
    length = torch.linalg.vector_norm(multiple, dim=-1, keepdim=True)
    return torch.cat((v, w), dim=-1) / torch.where(w < 0.0, -length, length)


def rotation_angle(a: Tensor, b: Tensor) -> Tensor:
    """The angle in rad between rotations (..., 3, 3); from the chord, so that small angles keep their digits.

    Example:
        >>> rotation_angle(torch.eye(3), so3.exp(torch.tensor([0.0, 0.3, 0.0])))
        tensor(0.3000)
    """
    chord = torch.linalg.matrix_norm(a - b) / math.sqrt(8.0)
    return 2 * torch.asin(chord.clamp(max=1.0))


@full_precision
def is_rotation(matrix: Tensor, tolerance: float = 1e-2) -> Tensor:
    """Whether each matrix (..., 3, 3) is a rotation: its columns orthonormal up to `tolerance`, and right-handed.

    Example:
        >>> is_rotation(torch.eye(3) * torch.tensor([1.0, -1.0, 2.0]).view(3, 1, 1))
        tensor([ True, False, False])
    """
    x, y, z = matrix.unbind(-1)
    gram = matrix.mT @ matrix - torch.eye(3, dtype=matrix.dtype, device=matrix.device)
    handed = (torch.linalg.cross(x, y, dim=-1) * z).sum(-1)
    return (gram.abs().amax((-2, -1)) <= tolerance) & (handed > 0)


@full_precision
def chordal_mean(rotations: Tensor) -> Tensor:
    """The rotation (3, 3) nearest to the sum of rotations (N, 3, 3), a robust mean after one trimming.

    Frames whose angle from the first mean is above three times the median angle are left out of the second.

    Example:
        >>> about_z = so3.exp(torch.tensor([[0.0, 0.0, 0.1], [0.0, 0.0, 0.2], [0.0, 0.0, 0.3]]))
        >>> rotation_angle(chordal_mean(about_z), torch.eye(3))
        tensor(0.2000)
    """

    def nearest(total: Tensor) -> Tensor:
        U, _, Vh = torch.linalg.svd(total)
        sign = torch.ones(3, dtype=total.dtype, device=total.device)
        sign[-1] = torch.det(U @ Vh)
        return (U * sign) @ Vh

    first = nearest(rotations.sum(0))
    angle = rotation_angle(first, rotations)
    return nearest(rotations[angle <= _OUTLIER * angle.median() + 1e-9].sum(0))
