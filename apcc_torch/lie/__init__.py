"""Rotations and rigid motions with derivatives that stay right at the identity."""

from __future__ import annotations

from apcc_torch.lie import se3, so3
from apcc_torch.lie.rotations import chordal_mean, quaternion_rotation, rotation_angle, rotation_quaternion

__all__ = [
    "chordal_mean",
    "quaternion_rotation",
    "rotation_angle",
    "rotation_quaternion",
    "se3",
    "so3",
]
