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
NUMBER, NAME = 10.0, 11.0
"""Type of numbers and names along the edges, points."""
GAP = 3.0
"""Between an edge, its numbers and its name, points."""
SHORTEST = 34.0
"""Of an edge with numbers, points."""
ROOM, BARE = ((60.0, 36.0), (14.0, 6.0)), (4.0, 4.0)
"""Around a box with and without numbers, points: left and below, right and above."""
STEPS = tuple(float(f"{m}e{e}") for e in range(-5, 4) for m in (1, 2, 5))
"""Between numbers along an edge, m."""


class Box(NamedTuple):
    """Limits of the drawn space, m: low (3,) and high (3,)."""

    low: Array
    high: Array


def bounding_box(*points: Array, margin: float = 0.05, least: float = 0.35) -> Box:
    """The box around points (..., 3) m and the base at the origin; margin and least side are shares of its longest."""
    flat = np.concatenate([np.zeros((1, 3)), *(p.reshape(-1, 3) for p in points)])
    flat = flat[np.isfinite(flat).all(-1)]
    low, high = flat.min(0), flat.max(0)
    side = float((high - low).max()) or 1.0
    widen = margin * side + np.maximum(0.0, least * side - (high - low)) / 2
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
    """Axes that show a box of space through a camera, which fills them.

    Args:
        ax: Empty axes, whose place in the figure is fixed: what is written around the box is laid out for it.
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
        size = 72.0 * np.array(ax.get_position().size) * ax.figure.get_size_inches()  # type: ignore[union-attr]
        # Room for numbers and names along the edges, points: at the left and below, at the right and above.
        before, behind = (np.array(ROOM[k] if frame else BARE) for k in (0, 1))
        self.scale = float(((size - before - behind) / (high - low)).min())
        spare = (size - before - behind) / self.scale - (high - low)
        start = low - before / self.scale - spare / 2
        ax.set_xlim(start[0], start[0] + size[0] / self.scale)
        ax.set_ylim(start[1], start[1] + size[1] / self.scale)
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
        step = next(s for s in STEPS if (high - low) / s <= 4.6)
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
        taken: list[Array] = []
        # The leftmost upright: every horizontal coordinate at the end that lies left in the picture.
        upright = np.array([low[k] if right[k] > 0 else high[k] for k in (0, 1)] + [low[2]])
        self._edge(2, upright, taken)
        for axis in (0, 1):
            start = np.array((near[0], near[1], floor))
            start[axis] = low[axis]
            self._edge(axis, start, taken)

    def _edge(self, axis: int, start: Array, taken: list[Array]) -> None:
        """One edge with its numbers and its name, beside each other and beside what is written already.

        Args:
            axis: Along which it runs.
            start: Its end at the box's low, (3,) m.
            taken: What is written, as (low, high) corners in points; what is added is appended.
        """
        end = start.copy()
        end[axis] = self.box.high[axis]
        self.plot(np.stack((start, end)), color=style.EDGE, linewidth=1.0, zorder=0.8)
        along = self.camera.project(end) - self.camera.project(start)
        length = float(np.linalg.norm(along)) * self.scale
        if length < SHORTEST:
            return  # seen nearly end on it has no room for numbers
        along = along / np.linalg.norm(along)
        outward = np.array((-along[1], along[0]))
        if (outward[1] > 0) if axis < 2 else (outward[0] > 0):
            outward = -outward
        ticks = list(self._ticks(axis))
        numbers = {float(tick): f"{tick:.3g}".replace("-", "\N{MINUS SIGN}") for tick in ticks}
        while len(ticks) > 1 and not self._apart([numbers[float(t)] for t in ticks], ticks, axis, start):
            # Every second one, zero among them where it is there.
            zero = next((i for i, tick in enumerate(ticks) if abs(tick) < 1e-12), 0)
            ticks = [tick for i, tick in enumerate(ticks) if (i - zero) % 2 == 0]
        depth = 0.0
        for tick in ticks:
            at = start.copy()
            at[axis] = tick
            half = _half_size(numbers[float(tick)], NUMBER)
            away = GAP + float(np.abs(outward) @ half)
            place = self.scale * self.camera.project(at) + away * outward
            if _free(place, half, taken):
                self._text(numbers[float(tick)], at, away * outward, color=style.MUTED, fontsize=NUMBER)
                taken.append(np.stack((place - half, place + half)))
                depth = max(depth, away + float(np.abs(outward) @ half))
        name = f"{'xyz'[axis]} (m)"
        half = _half_size(name, NAME)
        half = half[::-1] if axis == 2 else half
        middle = 0.5 * (start + end)
        away = depth + GAP + float(np.abs(outward) @ half)
        while not _free(self.scale * self.camera.project(middle) + away * outward, half, taken):
            away += 2.0
        place = self.scale * self.camera.project(middle) + away * outward
        taken.append(np.stack((place - half, place + half)))
        self._text(name, middle, away * outward, color=style.INK, fontsize=NAME, rotation=90 if axis == 2 else 0)

    def _apart(self, numbers: list[str], ticks: list[float], axis: int, start: Array) -> bool:
        """Whether numbers along an edge keep clear of each other."""
        places = []
        for tick in ticks:
            at = start.copy()
            at[axis] = tick
            places.append(self.scale * self.camera.project(at))
        halves = [_half_size(number, NUMBER) for number in numbers]
        return all(
            bool((np.abs(b - a) > u + v).any())
            for a, b, u, v in zip(places[:-1], places[1:], halves[:-1], halves[1:], strict=True)
        )

    def _text(self, text: str, at: Array, offset: Array, **look: Any) -> None:
        x, y = self.camera.project(at)
        middle: dict[str, Any] = {"ha": "center", "va": "center", "textcoords": "offset points"}
        self.ax.annotate(text, (float(x), float(y)), (float(offset[0]), float(offset[1])), **middle, **look)


def _half_size(text: str, points: float) -> Array:
    """Half the width and height of a text, points: digits are 0.64 of the type's size wide, with some room."""
    return np.array((0.32 * points * len(text) + 1.5, 0.5 * points + 1.5))


def _free(place: Array, half: Array, taken: list[Array]) -> bool:
    return not any(bool((place + half > low).all() and (place - half < high).all()) for low, high in taken)
