"""Frames of the messages: their names, and poses of what has a place or axes alone.

`world` has its origin at the arm's base and z up, as the poses of logs have it; `base` has the arm's axis along z;
`sensor_1` and so on are measured, and `tip` is the model's. Lengths are in m.
"""

from __future__ import annotations

import numpy as np

from apcc_torch.viewing.moment import Array

WORLD, BASE, TIP = "world", "base", "tip"


def sensor_frame(k: int) -> str:
    """Name of the frame of sensor k, from 0."""
    return f"sensor_{k + 1}"


def placed(place: Array) -> Array:
    """The pose (4, 4) of a place (3,), m, with the axes of `world`.

    Example:
        >>> placed(np.array([0.1, 0.0, 0.2]))[:, 3].tolist()
        [0.1, 0.0, 0.2, 1.0]
    """
    T = np.eye(4)
    T[:3, 3] = place
    return T


def turned(rotation: Array) -> Array:
    """The pose (4, 4) at the origin of `world` with axes (3, 3)."""
    T = np.eye(4)
    T[:3, :3] = rotation
    return T
