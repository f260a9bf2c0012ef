"""A round tube around a curve, as a mesh."""

from __future__ import annotations

from functools import cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[Any]

SIDES = 20


def tube(points: Array, radius: float) -> tuple[Array, Array]:
    """A closed mesh around a curve.

    Its cross-sections do not turn about the curve, so that shading runs smoothly along it (Wang et al., Computation of
    rotation minimizing frames, 2008: the double reflection).

    Args:
        points: (P, 3) the curve, m; no two in a row at one place.
        radius: m.

    Returns:
        Vertices (V, 3) m, float32, and faces (F, 3), uint32, of a number that P alone decides.
    """
    ring = _ring()
    across = _frames(points)
    around = ring @ across  # (P, SIDES, 3)
    body = points[:, None] + radius * around
    caps = body[[0, -1]]  # once more, for the edge to be sharp
    middles = points[[0, -1]]
    vertices = np.concatenate((body.reshape(-1, 3), caps.reshape(-1, 3), middles))
    return vertices.astype(np.float32), _faces(len(points))


@cache
def _ring() -> Array:
    angle = np.linspace(0.0, 2.0 * np.pi, SIDES, endpoint=False)
    return np.stack((np.cos(angle), np.sin(angle)), axis=-1)


def _frames(points: Array) -> Array:
    """(P, 2, 3) two directions across the curve at each of its points."""
    along = np.gradient(points, axis=0)
    along /= np.linalg.norm(along, axis=-1, keepdims=True).clip(1e-12)
    first = np.eye(3)[np.abs(along[0]).argmin()]
    first = first - (first @ along[0]) * along[0]
    x = [first / np.linalg.norm(first)]
    for k in range(len(points) - 1):
        step = points[k + 1] - points[k]
        square = max(step @ step, 1e-24)
        turned = x[-1] - (2.0 / square) * (step @ x[-1]) * step
        tangent = along[k] - (2.0 / square) * (step @ along[k]) * step
        other = along[k + 1] - tangent
        size = other @ other
        # Where the curve is an arc, the second reflection is the identity only up to rounding.
        turned = turned if size < 1e-24 else turned - (2.0 / size) * (other @ turned) * other
        x.append(turned)
    first_axis = np.array(x)
    return np.stack((first_axis, np.cross(along, first_axis)), axis=1)


@cache
def _faces(P: int) -> Array:
    k, s = np.meshgrid(np.arange(P - 1), np.arange(SIDES), indexing="ij")
    after = (s + 1) % SIDES
    a, b, c, d = (k * SIDES + s, k * SIDES + after, (k + 1) * SIDES + s, (k + 1) * SIDES + after)
    sides = np.stack((np.stack((a, b, d), -1), np.stack((a, d, c), -1)), axis=-2).reshape(-1, 3)
    around = np.arange(SIDES)
    begin, end, middle = P * SIDES, (P + 1) * SIDES, (P + 2) * SIDES
    first = np.stack((begin + (around + 1) % SIDES, begin + around, np.full(SIDES, middle)), axis=-1)
    last = np.stack((end + around, end + (around + 1) % SIDES, np.full(SIDES, middle + 1)), axis=-1)
    return np.concatenate((sides, first, last)).astype(np.uint32)
