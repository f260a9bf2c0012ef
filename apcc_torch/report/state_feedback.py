"""Figures 23 to 26: what algorithm 2 infers of one motion, decoupled and not, from poses and from positions."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from torch import Tensor

from apcc_torch.report import style
from apcc_torch.report.backbone_drawing import draw_arms, draw_base, draw_markers, space_key, span_text, spread_indices
from apcc_torch.report.space import Camera, Space, bounding_box
from apcc_torch.report.style import values

TIME = "time (s)"


class Estimate(NamedTuple):
    """One estimator over a run.

    time: (T,) s. points: (T, N, 3) along the model, m. sensors: (T, k, 3) measured, m. angular: (T, k) rad, and
    linear: (T, k) m: residual norms of algorithm 2.
    """

    time: Tensor
    points: Tensor
    sensors: Tensor
    angular: Tensor
    linear: Tensor


Estimates = dict[tuple[str, str], Estimate]
"""(case, mode) -> estimator: case "non-decoupled" or "decoupled", mode "pose" or "position"."""


def four_panel_figure(estimates: Estimates, moments: int = 6, title: str = "") -> Figure:
    """The models of the four estimators at moments of a run, with the measured sensors. Figs. 23, 24 [Dalenberg]."""
    box = bounding_box(
        *(values(e.points) for e in estimates.values()), *(values(e.sensors) for e in estimates.values())
    )
    cases = list(dict.fromkeys(case for case, _ in estimates))
    modes = list(dict.fromkeys(mode for _, mode in estimates))
    height = 4.4 * len(cases) + 0.6
    figure = style.new_figure(9.0, height, constrained=False)
    edges = {"left": 0.005, "right": 0.995, "bottom": 0.05 / height, "top": 1.0 - 0.75 / height}
    axes = figure.subplots(len(cases), len(modes), squeeze=False, gridspec_kw={**edges, "wspace": 0.02, "hspace": 0.09})
    for i, case in enumerate(cases):
        for j, mode in enumerate(modes):
            e = estimates[case, mode]
            chosen = spread_indices(e.time, 0.0, float(e.time[-1]), moments)
            space = Space(axes[i, j], box, Camera())
            draw_base(space)
            draw_arms(space, values(e.points[chosen]), style.MODEL, 2.2)
            draw_markers(space, values(e.sensors[chosen]), 4.5)
            axes[i, j].set_title(f"{case}, {mode}", fontsize=style.TITLE, color=style.INK)
    time = next(iter(estimates.values())).time
    head = (
        f"{title}; {span_text(time[[0, -1]])}; red: measured" if title else f"{span_text(time[[0, -1]])}; red: measured"
    )
    figure.text(0.5, 1.0 - 0.3 / height, head, ha="center", fontsize=style.LABEL, color=style.MUTED)
    return figure


def final_figure(shapes: Mapping[str, tuple[Tensor, Tensor]]) -> Figure:
    """The arm at the end of runs: a smooth curve through what was measured. Fig. 25 [Dalenberg].

    Args:
        shapes: Run -> points (N, 3) of the curve and sensors (k, 3), m.
    """
    box = bounding_box(*(values(part) for pair in shapes.values() for part in pair))
    columns = min(len(shapes), 3)
    rows = -(-len(shapes) // columns)
    height = 0.5 + 4.2 * rows
    figure = style.new_figure(min(4.6 * columns, style.WIDEST), height, constrained=False)
    edges = {"left": 0.005, "right": 0.995, "bottom": 0.1 / height, "top": 1.0 - 0.75 / height}
    axes = figure.subplots(rows, columns, squeeze=False, gridspec_kw={**edges, "wspace": 0.02, "hspace": 0.1}).ravel()
    for ax in axes[len(shapes) :]:
        ax.set_axis_off()
    for ax, (name, (points, places)) in zip(axes, shapes.items(), strict=False):
        space = Space(ax, box, Camera())
        draw_base(space)
        draw_arms(space, np.concatenate((np.zeros((1, 3)), values(points)))[None], style.TRUE, 4.0)
        draw_markers(space, values(places))
        ax.set_title(name.replace("_", " "), fontsize=style.TITLE, color=style.INK)
    sensors = space_key(target=False)[-1]
    keys = [Line2D([], [], color=style.TRUE, linewidth=4.0, label="curve through the sensors"), sensors]
    style.figure_legend(figure, keys, loc="upper center")
    return figure


def norm_figure(runs: Sequence[Estimates], mode: str = "pose") -> Figure:
    """Residual norms over time, mean over the runs, a curve a sensor and a dash a case. Fig. 26 [Dalenberg].

    Args:
        runs: Of all runs; they may end at different times, and count as long as they last.
        mode: Of the estimator.
    """
    figure = style.new_figure(10.0, 6.0)
    panels = figure.subplots(2, 1, sharex=True)
    longest = max((run[key].time for run in runs for key in run if key[1] == mode), key=lambda time: float(time[-1]))
    grid = values(longest)
    for dash, case in enumerate(dict.fromkeys(case for case, way in runs[0] if way == mode)):
        for ax, field, scale in ((panels[0], "linear", 1e2), (panels[1], "angular", 1e2)):
            curves = np.stack([_on(grid, run[case, mode], field) for run in runs])
            mean = scale * np.nanmean(curves, axis=0)
            for s in range(mean.shape[-1]):
                look = {"color": style.SERIES[s], "linestyle": style.DASHES[dash], "linewidth": style.LINE}
                ax.plot(grid, mean[:, s], label=f"sensor {s + 1}, {case}", **look)
    style.dress(panels[0], "", "position (cm)", f"residual norms of algorithm 2, mean over {len(runs)} runs, {mode}s")
    style.dress(panels[1], TIME, "angle (crad)")
    style.legend(panels[0], ncols=2)
    style.fit_time(panels[1], grid)
    return figure


def _on(grid: style.Array, e: Estimate, field: str) -> style.Array:
    """(G, k) a field on a common grid of times; NaN after its run's end."""
    time, data = values(e.time), values(getattr(e, field))
    columns = [np.interp(grid, time, column, right=np.nan) for column in data.T]
    return np.stack(columns, axis=-1)
