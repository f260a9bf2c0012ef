"""Poses as they are streamed, turned to z up and expressed in the arm's base frame."""

from __future__ import annotations

import numpy as np
import torch

from apcc_torch.errors import HardwareError, ShapeError, ValueRangeError
from apcc_torch.hardware.interfaces import Array
from apcc_torch.hardware.mocap.settings import MocapSettings
from apcc_torch.lie.rotations import chordal_mean, quaternion_rotation, rotation_angle

# The y-up axes turned so that y becomes z: (x, y, z) -> (x, -z, y).
_Y_TO_Z = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])


def rotations(quaternions: Array) -> Array:
    """Rotation matrices (n, 3, 3) of quaternions (n, 4), x y z w, near to length 1: their length is taken out."""
    unit = quaternions / np.linalg.norm(quaternions, axis=-1, keepdims=True)
    return np.asarray(quaternion_rotation(torch.from_numpy(unit)).numpy())


def poses(positions: Array, quaternions: Array) -> Array:
    """Poses (n, 4, 4) from positions (n, 3) in m and quaternions (n, 4), x y z w."""
    T = np.zeros((len(positions), 4, 4))
    T[:, :3, :3], T[:, :3, 3], T[:, 3, 3] = rotations(quaternions), positions, 1.0
    return T


def check_pose(name: str, T: Array) -> Array:
    """Returns `T` if it is a pose (4, 4).

    Raises:
        ShapeError: It has another shape.
        ValueRangeError: Its rotation is none, or its last row is not 0 0 0 1.
    """
    if np.shape(T) != (4, 4):
        raise ShapeError(f"{name} must have shape (4, 4), got {np.shape(T)}")
    R = T[:3, :3]
    proper = np.allclose(R.T @ R, np.eye(3), atol=1e-6) and np.linalg.det(R) > 0
    if not (proper and np.isfinite(T).all() and np.array_equal(T[3], (0, 0, 0, 1))):
        raise ValueRangeError(f"{name} must be a pose: a rotation, a position in m, and the row 0 0 0 1")
    return T


def pose_distance(a: Array, b: Array) -> tuple[float, float]:
    """Distance in m and angle in rad between two poses (4, 4)."""
    angle = rotation_angle(torch.tensor(a[:3, :3]), torch.tensor(b[:3, :3]))
    return float(np.linalg.norm(a[:3, 3] - b[:3, 3])), float(angle)


def mean_pose(T: Array) -> Array:
    """The mean (4, 4) of poses (N, 4, 4) of one body at rest: median position, trimmed chordal mean rotation."""
    mean = np.eye(4)
    mean[:3, :3] = chordal_mean(torch.from_numpy(np.ascontiguousarray(T[:, :3, :3]))).numpy()
    mean[:3, 3] = np.median(T[:, :3, 3], axis=0)
    return mean


class BaseFrame:
    """The streamed poses' way into the arm's base frame.

    The world of these poses is the cameras', z up and in m. A stream turns bodies' own axes with the world's, so a y-up
    stream gives R' = C R C^T with the axes' turn C: the same poses as if it streamed z up.
    """

    def __init__(self, settings: MocapSettings) -> None:
        self._y_up = settings.up == "y"
        offset = np.array([settings.base_offset], dtype=np.float64)
        self._offset = poses(offset, np.array([settings.base_quaternion], dtype=np.float64))[0]

    def world(self, positions: Array, quaternions: Array) -> Array:
        """Poses (n, 4, 4) in the z-up world from positions (n, 3) in m and quaternions (n, 4) in the streamed axes."""
        T = poses(positions, quaternions)
        if self._y_up:
            T[:, :3, :3] = _Y_TO_Z @ T[:, :3, :3] @ _Y_TO_Z.T
            T[:, :3, 3] = T[:, :3, 3] @ _Y_TO_Z.T
        return T

    def base(self, body: Array) -> Array:
        """The arm's base frame (4, 4) in the world, from the pose (4, 4) of the base's rigid body."""
        return np.asarray(body @ self._offset)

    @staticmethod
    def relative(base: Array, T: Array) -> Array:
        """Poses (n, 4, 4) of the world in the base frame (4, 4)."""
        relative = T.copy()
        relative[:, :3, :3] = base[:3, :3].T @ T[:, :3, :3]
        relative[:, :3, 3] = (T[:, :3, 3] - base[:3, 3]) @ base[:3, :3]
        return relative

    def measure(self, bodies: Array, settings: MocapSettings) -> Array:
        """The arm's base frame (4, 4) in the world, from poses (N, 4, 4) of a base that stands still.

        Raises:
            HardwareError: It does not.
        """
        mean = mean_pose(bodies)
        apart = [pose_distance(mean, body) for body in bodies]
        far, turned = (max(values) for values in zip(*apart, strict=True))
        if far > settings.base_position_tolerance or turned > settings.base_angle_tolerance:
            raise HardwareError(
                f"the base body {settings.base!r} moved while it was measured: up to {1e3 * far:.1f} mm and "
                f"{turned:.3f} rad from the mean of {len(bodies)} frames"
            )
        return self.base(mean)
