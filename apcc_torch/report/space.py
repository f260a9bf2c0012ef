"""Three-dimensional space on flat axes: an orthographic camera, and a box with walls, grid and metres on its edges.

The projection is done here, not by matplotlib's 3-D axes, so that panels use their whole area, drawing order is what
the caller says, and an animation can redraw its lines alone.
"""

from __future__ import annotations

import math
from itertools import product
from typing import Any, NamedTuple

import numpy as np
from matplotlib.axes import Axes
from matplotlib.lines import Line2D
from matplotlib.patches import Polygon

from apcc_torch.report import style
from apcc_torch.report.style import Array

WALLS = ("#f3f5f8", "#f8f9fb", "#eef1f5")


class Box(NamedTuple):
    """Limits of the drawn space, m: low (3,) and high (3,)."""

    low: Array
    high: Array


def bounding_box(*points: Array, margin: float = 0.03, least: float = 0.2) -> Box:
    """The box around points (..., 3) m and the base at the origin; each side is at least `least` m long."""
    flat = np.concatenate([np.zeros((1, 3)), *(p.reshape(-1, 3) for p in points)])
    flat = flat[np.isfinite(flat).all(-1)]
    low, high = flat.min(0) - margin, flat.max(0) + margin
    widen = np.maximum(0.0, least - (high - low)) / 2
    return Box(low - widen, high + widen)


class Camera(NamedTuple):
    """An orthographic view from elevation and azimuth, degrees; azimuth is counted from the world's x towards y."""

    elevation: float = 14.0
    azimuth: float = -62.0

    def axes(self) -> Array:
        """Rows: the world's directions (2, 3) that point right and up in the picture."""
        e, a = math.radians(self.elevation), math.radians(self.azimuth)
        right = (-math.sin(a), math.cos(a), 0.0)
        up = (-math.sin(e) * math.cos(a), -math.sin(e) * math.sin(a), math.cos(e))
        return np.array((right, up))

    def towards(self) -> Array:
        """The direction (3,) from the scene to the camera."""
        e, a = math.radians(self.elevation), math.radians(self.azimuth)
        return np.array((math.cos(e) * math.cos(a), math.cos(e) * math.sin(a), math.sin(e)))

    def project(self, points: Array) -> Array:
        """Positions (..., 3) m in the world -> (..., 2) m in the picture."""
        return points @ self.axes().T


class Space:
    """Axes that show a box of space through a camera.

    Args:
        ax: Empty axes.
        box: What to show.
        camera: From where.
        frame: Whether walls, grid and labels are drawn.
    """

    def __init__(self, ax: Axes, box: Box, camera: Camera | None = None, frame: bool = True) -> None:
        self.ax, self.box = ax, box
        self.camera = Camera() if camera is None else camera
        ax.set_axis_off()
        ax.set_aspect("equal", adjustable="box")
        corners = self.camera.project(np.array(list(product(*zip(box.low, box.high, strict=True)))))
        low, high = corners.min(0), corners.max(0)
        side = max(high - low)
        # Room for the numbers and names along the edges, in parts of the picture.
        pad = (0.135, 0.02, 0.13, 0.01) if frame else (0.01, 0.01, 0.01, 0.01)
        ax.set_xlim(low[0] - pad[0] * side, high[0] + pad[1] * side)
        ax.set_ylim(low[1] - pad[2] * side, high[1] + pad[3] * side)
        if frame:
            self._walls()
            self._edges()

    def plot(self, points: Array, **look: Any) -> Line2D:
        """A line through points (N, 3)."""
        return self.ax.plot(*self.camera.project(points).T, **look)[0]

    def _far(self) -> Array:
        """The corner (3,) away from the camera, at the box's floor."""
        return np.where(self.camera.towards() > 0, self.box.low, self.box.high)

    def _ticks(self, axis: int) -> Array:
        low, high = self.box.low[axis], self.box.high[axis]
        step = next(s for s in (0.02, 0.05, 0.1, 0.2, 0.5, 1.0, 2.0, 5.0, 1e9) if (high - low) / s <= 4.6)
        return step * np.arange(math.ceil(low / step - 1e-9), math.floor(high / step + 1e-9) + 1.0) + 0.0

    def _walls(self) -> None:
        far = self._far()
        for axis, color in enumerate(WALLS):
            u, v = (k for k in range(3) if k != axis)
            lows, highs = self.box.low, self.box.high
            ring = np.tile(far, (4, 1))
            ring[:, u] = lows[u], highs[u], highs[u], lows[u]
            ring[:, v] = lows[v], lows[v], highs[v], highs[v]
            self.ax.add_patch(
                Polygon(self.camera.project(ring), closed=True, facecolor=color, edgecolor="none", zorder=0)
            )
            for along, across in ((u, v), (v, u)):
                for tick in self._ticks(along):
                    line = np.tile(far, (2, 1))
                    line[:, along] = tick
                    line[:, across] = lows[across], highs[across]
                    self.plot(line, color="#dde2e8", linewidth=0.8, zorder=0.5)

    def _edges(self) -> None:
        """Numbers along the two floor edges that face the camera and along the left upright."""
        low, high = self.box.low, self.box.high
        toward = self.camera.towards()
        near = np.where(toward > 0, high, low)
        floor = low[2] if toward[2] >= 0 else high[2]
        right = self.camera.axes()[0]
        for axis in (0, 1):
            start = np.array((near[0], near[1], floor))
            start[axis] = low[axis]
            # Of the two edges that meet in the near corner one runs left and one right; their numbers keep apart.
            leftwards = bool((right[axis] > 0) == (near[axis] == high[axis]))
            self._edge(axis, start, (-2, -4) if leftwards else (2, -4), ("right" if leftwards else "left", "top"))
        # The leftmost upright: every horizontal coordinate at the end that lies left in the picture.
        start = np.array([low[k] if right[k] > 0 else high[k] for k in (0, 1)] + [low[2]])
        self._edge(2, start, (-5, 0), ("right", "center"))

    def _edge(self, axis: int, start: Array, offset: tuple[int, int], align: tuple[str, str]) -> None:
        end = start.copy()
        end[axis] = self.box.high[axis]
        self.plot(np.stack((start, end)), color=style.EDGE, linewidth=1.0, zorder=0.8)
        # An edge seen nearly end on has no room for numbers.
        span = self.camera.project(end) - self.camera.project(start)
        corners = self.camera.project(np.stack((self.box.low, self.box.high)))
        room = float(np.linalg.norm(span)) / float(np.linalg.norm(corners[1] - corners[0]) + 1e-12)
        if room < 0.12:
            return
        ticks = self._ticks(axis)
        if room < 0.35:
            ticks = ticks[:: max(1, len(ticks) - 1)]
        numbers = [f"{tick:.3g}".replace("-", "−") for tick in ticks]
        for tick, number in zip(ticks, numbers, strict=True):
            at = start.copy()
            at[axis] = tick
            self._text(number, at, offset, color=style.MUTED, fontsize=9.5, ha=align[0], va=align[1])
        upright = axis == 2
        look = {"rotation": 90 if upright else 0, "ha": "center", "va": "center" if upright else "top"}
        steep = min(1.0, abs(float(span[1])) / (abs(float(span[0])) + 1e-12))
        # Beside a steep edge the name stands next to the numbers, beneath a flat one under them.
        width = 5 * max(map(len, numbers), default=0)
        aside = round(16 + width * steep)
        beside = (-aside if align[0] == "right" else aside, round(10 * steep) - 19)
        away = (-16 - width, 0) if upright else beside
        self._text(f"{'xyz'[axis]} (m)", 0.5 * (start + end), away, color=style.INK, fontsize=10.5, **look)

    def _text(self, text: str, at: Array, offset: tuple[int, int], **look: Any) -> None:
        x, y = self.camera.project(at)
        self.ax.annotate(text, (float(x), float(y)), offset, textcoords="offset points", **look)
