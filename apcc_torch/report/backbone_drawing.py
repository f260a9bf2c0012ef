"""Arms in space: backbones, sensors and targets on three-dimensional axes, and the stroboscopic comparison."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Polygon
from torch import Tensor

from apcc_torch.errors import ShapeError
from apcc_torch.model.abscissae import decouple
from apcc_torch.model.kinematic_model import KinematicModel
from apcc_torch.report import style
from apcc_torch.report.space import Camera, Space, bounding_box
from apcc_torch.report.style import Array, values
from apcc_torch.shapes import check_tensor

VIEWS = ((14.0, -62.0), (14.0, -14.0))
"""(elevation, azimuth) of the two cameras, degrees: from the side and from the front."""


class Snapshots(NamedTuple):
    """S moments of one arm and of its model, world frame.

    time: (S,) s, increasing.
    true_points: (S, N, 3) along the true arm, m.
    model_points: (S, M, 3) along the model, m.
    true_markers: (S, k, 3) sensors and actuators on the true arm, m; k may be 0.
    model_markers: (S, k, 3) where the model has them, m.
    target: (3,) or (S, 3) m, or None.
    """

    time: Tensor
    true_points: Tensor
    model_points: Tensor
    true_markers: Tensor
    model_markers: Tensor
    target: Tensor | None = None


def check_snapshots(name: str, shots: Snapshots) -> None:
    """Raises ShapeError where the fields do not fit each other."""
    S = len(check_tensor(f"{name}.time", shots.time, (None,)))
    for field in ("true_points", "model_points", "true_markers", "model_markers"):
        check_tensor(f"{name}.{field}", getattr(shots, field), (S, None, 3))
    if S == 0:
        raise ShapeError(f"{name}.time must hold at least one moment, got an empty tensor")


def marker_positions(backbone: KinematicModel, q: Tensor, L0: Tensor, abscissae: Tensor) -> Tensor:
    """Where material points lie on an arm, by algorithm 1.

    Args:
        backbone: The arm or the model.
        q: (..., 3 n_b) its configuration.
        L0: (..., n_b) its rest lengths, m.
        abscissae: (k,) material abscissae, m.

    Returns:
        (..., k, 3) m, world frame.
    """
    X_tilde, j = decouple(abscissae.to(L0), L0)
    return backbone.pose(q, L0, X_tilde, j)[..., :3, 3]


def spread_indices(time: Tensor, start: float, end: float, count: int) -> list[int]:
    """Indices of up to `count` moments spread evenly over [start, end] s, without repeats."""
    stamps = values(time)
    wanted = np.linspace(max(start, float(stamps[0])), min(end, float(stamps[-1])), count)
    nearest = np.abs(stamps[:, None] - wanted[None]).argmin(0)
    return sorted({int(k) for k in nearest})


def draw_arms(
    space: Space,
    points: Array,
    color: str,
    width: float = style.LINE,
    fade: tuple[float, float] = (0.28, 1.0),
    zorder: float = 2.0,
) -> list[Line2D]:
    """Draws S shapes (S, N, 3) from the first to the last strength of `fade`, 1 the full colour; returns the lines."""
    S = len(points)
    strengths = np.linspace(*fade, S) if S > 1 else np.array(fade[1:])
    looks = [
        {
            "color": style.faded(color, float(s)),
            "linewidth": width,
            "solid_capstyle": "round",
            "zorder": zorder + 0.5 * k / S,
        }
        for k, s in enumerate(strengths)
    ]
    return [space.plot(shape, **look) for shape, look in zip(points, looks, strict=True)]


def draw_markers(space: Space, points: Array, size: float = 6.0, zorder: float = 5.0) -> Line2D:
    """Red dots at (..., 3)."""
    look = {"marker": "o", "linestyle": "none", "color": style.SENSOR, "markersize": size}
    return space.plot(points.reshape(-1, 3), markeredgecolor="white", markeredgewidth=0.7, zorder=zorder, **look)


def draw_target(space: Space, target: Array) -> Line2D:
    """A star at each of (..., 3)."""
    look = {"marker": "*", "linestyle": "none", "color": style.TARGET, "markersize": 16.0}
    return space.plot(target.reshape(-1, 3), markeredgecolor="white", markeredgewidth=0.9, zorder=6.0, **look)


def draw_base(space: Space) -> None:
    """The plate that the arm is fixed to, at the origin; it goes with the size of what is shown."""
    half = 0.06 * float((space.box.high - space.box.low).max())
    ring = np.array([(-half, -half, 0.0), (half, -half, 0.0), (half, half, 0.0), (-half, half, 0.0)])
    flat = Polygon(space.camera.project(ring), closed=True, facecolor="#cbd2d9", edgecolor=style.EDGE, zorder=1.5)
    space.ax.add_patch(flat)


def space_key(markers: bool = True, target: bool = True, path: bool = False) -> list[Line2D]:
    """Handles for a legend of what these drawings hold."""
    keys = [
        Line2D([], [], color=style.TRUE, linewidth=4.0, label="true system"),
        Line2D([], [], color=style.MODEL, linewidth=1.8, label="virtual model"),
    ]
    dot = {"linestyle": "none", "markeredgecolor": "white"}
    if markers:
        keys.append(Line2D([], [], marker="o", color=style.SENSOR, markersize=7, label="sensors", **dot))  # type: ignore[arg-type]
    if target:
        keys.append(Line2D([], [], marker="*", color=style.TARGET, markersize=14, label="target", **dot))  # type: ignore[arg-type]
    if path:
        keys.append(Line2D([], [], color=style.TARGET, linewidth=1.4, linestyle=":", label="desired path"))
    return keys


def draw_views(spaces: Sequence[Space], shots: Snapshots, markers_on_true: bool = True) -> None:
    """The three columns of a stroboscopic plot: true system, virtual model, overlap."""
    true, model = values(shots.true_points), values(shots.model_points)
    left, middle, right = spaces
    for space in spaces:
        draw_base(space)
        if shots.target is not None:
            draw_target(space, values(shots.target))
    draw_arms(left, true, style.TRUE, 3.0)
    draw_arms(middle, model, style.MODEL, 2.4)
    draw_arms(right, true, style.TRUE, 5.0, (0.15, 0.6))
    draw_arms(right, model, style.MODEL, 1.6, (0.45, 1.0), zorder=3.0)
    draw_markers(middle, values(shots.model_markers))
    if markers_on_true:
        draw_markers(left, values(shots.true_markers))
        draw_markers(right, values(shots.true_markers[-1]))


def span_text(time: Tensor) -> str:
    """ "pale to dark: t = 0 to 3 s"."""
    begin = max(float(time[0]), 0.0)  # an arm's first frame may be from just before its run
    return f"pale to dark: t = {begin:.3g} to {float(time[-1]):.3g} s"


def stroboscopic_figure(
    runs: Mapping[str, Snapshots], views: Sequence[tuple[float, float]] = VIEWS, title: str = ""
) -> Figure:
    """True system, virtual model and overlap of each controller, from two angles. Figs. 14, 41 [Dalenberg].

    Args:
        runs: Controller name -> moments of its run, top row first: {"standard": …, "adaptive": …}.
        views: (elevation, azimuth) of each camera, degrees.
        title: Text over the figure.

    Raises:
        ShapeError, DtypeError: A field does not fit the others.
    """
    for name, shots in runs.items():
        check_snapshots(name, shots)
    everything = [values(p) for s in runs.values() for p in (s.true_points, s.model_points)]
    everything += [values(s.target) for s in runs.values() if s.target is not None]
    box = bounding_box(*everything)
    rows = len(runs) * len(views)
    across, up = float((box.high - box.low)[:2].max()), float((box.high - box.low)[2])
    tall = min(max(2.0 * up / across, 2.7), 3.6)  # a hanging arm is narrow: it is shown as large as the width allows
    figure = style.new_figure(10.0, 1.25 + tall * rows, constrained=False)
    height = figure.get_figheight()
    grid = figure.add_gridspec(
        rows, 3, left=0.045, right=0.995, bottom=0.4 / height, top=1 - 0.85 / height, wspace=0.02, hspace=0.03
    )
    row = 0
    for name, shots in runs.items():
        for number, view in enumerate(views):
            draw_views([Space(figure.add_subplot(grid[row, c]), box, Camera(*view)) for c in range(3)], shots)
            middle = 1 - (0.85 + (height - 1.25) * (row + 0.5) / rows) / height
            color = style.controller_color(name, row // len(views))
            label = f"{name}, view {number + 1}"
            figure.text(0.012, middle, label, rotation=90, va="center", color=color, fontsize=style.TITLE)
            row += 1
    for c, head in enumerate(("true system", "virtual model", "overlap")):
        figure.text(
            0.045 + 0.94 * (c + 0.5) / 3, 1 - 0.78 / height, head, ha="center", fontsize=style.TITLE, color=style.INK
        )
    shots = next(iter(runs.values()))
    has_target = any(s.target is not None for s in runs.values())
    figure.legend(
        handles=space_key(target=has_target), loc="upper center", ncols=4, frameon=False, fontsize=style.LEGEND,
        bbox_to_anchor=(0.5, 1 - (0.28 if title else 0.08) / height), labelcolor=style.INK,
    )  # fmt: skip
    figure.text(0.985, 0.1 / height, span_text(shots.time), ha="right", fontsize=10, color=style.MUTED)
    if title:
        figure.text(0.5, 1 - 0.24 / height, title, ha="center", fontsize=style.TITLE, color=style.INK)
    return figure
