"""The figure of a replayed recording: what the estimator inferred, how well, and what the gate kept from it."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Patch
from torch import Tensor

from apcc_torch.errors import ShapeError
from apcc_torch.estimation.sensor_gate import Reason
from apcc_torch.model.coordinates import CONSTANT_CURVATURE, Coordinates
from apcc_torch.report import style
from apcc_torch.report.style import Array, values
from apcc_torch.shapes import check_tensor

REASON_COLORS = {
    Reason.UNTRACKED: "#7b8794",
    Reason.NON_FINITE: style.INK,
    Reason.NOT_A_ROTATION: style.PURPLE,
    Reason.OUT_OF_REACH: style.ORANGE,
    Reason.TWISTED: style.SKY,
    Reason.JUMP: style.VERMILION,
    Reason.TOO_BENT: style.GREEN,
}


class ReplayCurves(NamedTuple):
    """One replayed recording, time first.

    time: (T,) s.
    q_bar: (T, 3 n_b) inferred configuration, rad and m.
    angular: (T, k) rad, and linear: (T, k) m: residual norms of algorithm 2.
    position_reason: (T, k) and orientation_reason: (T, k) int64 `Reason`: why the gate held a sensor back; 0 where not.
    """

    time: Tensor
    q_bar: Tensor
    angular: Tensor
    linear: Tensor
    position_reason: Tensor
    orientation_reason: Tensor


def check_replay(curves: ReplayCurves) -> None:
    """Raises ShapeError or DtypeError where the fields do not fit each other."""
    T = len(check_tensor("time", curves.time, (None,)))
    check_tensor("q_bar", curves.q_bar, (T, None))
    k = check_tensor("linear", curves.linear, (T, None)).shape[-1]
    if curves.q_bar.shape[-1] % 3:
        raise ShapeError(f"q_bar must have shape (T, 3 n_b), got {tuple(curves.q_bar.shape)}")
    check_tensor("angular", curves.angular, (T, k))
    for name in ("position_reason", "orientation_reason"):
        if getattr(curves, name).shape != (T, k):
            raise ShapeError(f"{name} must have shape {(T, k)}, got {tuple(getattr(curves, name).shape)}")


def replay_figure(
    curves: ReplayCurves,
    names: Sequence[str] | None = None,
    title: str = "",
    coordinates: Coordinates = CONSTANT_CURVATURE,
) -> Figure:
    """Bends, elongations, residuals of positions and rotations, and a timeline of the gate.

    A residual is drawn where the gate let its measurement through; ticks over the panel mark the frames held back, a
    row a sensor in the order of the legend, coloured by reason as in the timeline.

    Args:
        curves: The replay.
        names: The sensors' names, k of them; None numbers them.
        title: Text over the figure.
        coordinates: What q_bar is made of.

    Raises:
        ShapeError, DtypeError: The fields do not fit each other.
    """
    check_replay(curves)
    k = curves.linear.shape[-1]
    heads = [f"sensor {s + 1}" for s in range(k)] if names is None else list(names)
    if len(heads) != k:
        raise ShapeError(f"names must have {k} entries, got {len(heads)}")
    figure = style.new_figure(10.0, 10.5)
    bends, lengths, linear, angular, gates = figure.subplots(
        5, 1, sharex=True, height_ratios=(1.35, 1.0, 1.1, 1.1, 0.35 + 0.28 * k)
    )
    time = values(curves.time)
    _draw_configuration(bends, lengths, time, curves.q_bar, coordinates)
    _draw_residuals(linear, time, 1e3 * values(curves.linear), values(curves.position_reason), heads)
    _draw_residuals(angular, time, 1e2 * values(curves.angular), values(curves.orientation_reason), heads)
    style.dress(linear, "", "linear\nresidual (mm)")
    style.dress(angular, "", "angular\nresidual (crad)")
    _above(linear, min(k, 4))
    _draw_timeline(gates, time, values(curves.position_reason), values(curves.orientation_reason), heads)
    style.fit_time(gates, time)
    figure.align_ylabels([bends, lengths, linear, angular])
    if title:
        figure.suptitle(title, fontsize=style.TITLE, color=style.INK, x=0.01, ha="left")
    return figure


def _above(ax: Axes, columns: int) -> None:
    style.legend(ax, loc="lower right", bbox_to_anchor=(1.0, 1.0), ncols=columns, columnspacing=1.3, borderpad=0.1)


def _draw_configuration(bends: Axes, lengths: Axes, time: Array, q: Tensor, coordinates: Coordinates) -> None:
    bend, stretch = values(coordinates.bends(q)), values(q[:, coordinates.elongations])
    for i in range(stretch.shape[1]):
        color = style.SERIES[i % len(style.SERIES)]
        bends.plot(time, bend[:, i, 0], color=color, linewidth=1.5, label=f"section {i + 1}")
        bends.plot(time, bend[:, i, 1], color=color, linewidth=1.2, linestyle=(0, (4, 1.5)))
        lengths.plot(time, 1e2 * stretch[:, i], color=color, linewidth=1.5)
    style.dress(bends, "", "bend (rad)", r"$\Delta_x$ solid, $\Delta_y$ dashed")
    style.dress(lengths, "", "elongation (cm)")
    _above(bends, 6)


def _draw_residuals(ax: Axes, time: Array, residual: Array, reason: Array, names: Sequence[str]) -> None:
    for s, name in enumerate(names):
        held = reason[:, s] != Reason.OK
        shown = np.where(held, np.nan, residual[:, s])
        ax.plot(time, shown, color=style.SERIES[s % len(style.SERIES)], linewidth=1.3, label=name)
        for code, color in REASON_COLORS.items():
            at = time[reason[:, s] == code]
            height = 0.97 - 0.07 * s
            look: dict[str, Any] = {
                "linestyle": "none",
                "marker": "|",
                "markersize": 5.0,
                "markeredgewidth": 1.0,
                "color": color,
            }
            if len(at):
                ax.plot(at, np.full(len(at), height), transform=ax.get_xaxis_transform(), **look)
    finite = residual[np.isfinite(residual) & (reason == Reason.OK)]
    top = float(finite.max()) if finite.size else 0.0
    ax.set_ylim(0.0, top * (1.12 + 0.1 * len(names)) if top > 0 else 1.0)


def spans(time: Array, held: Array) -> list[tuple[float, float]]:
    """(start, duration) s of each unbroken stretch of `held` (T,); each frame lasts until the next."""
    edges = np.flatnonzero(np.diff(np.concatenate(([0], held.astype(np.int8), [0]))))
    step = float(np.median(np.diff(time))) if len(time) > 1 else 1.0
    ends = np.append(time[1:], time[-1] + step)
    return [(float(time[a]), float(ends[b - 1] - time[a])) for a, b in edges.reshape(-1, 2)]


def _draw_timeline(ax: Axes, time: Array, position: Array, orientation: Array, names: Sequence[str]) -> None:
    rows = [(name, kind, codes[:, s]) for s, name in enumerate(names) for kind, codes in
            (("position", position), ("rotation", orientation))]  # fmt: skip
    least = 0.0015 * float(time[-1] - time[0])  # a single frame must still be seen
    for row, (_, _, codes) in enumerate(rows):
        ax.axhspan(row - 0.36, row + 0.36, color="#f3f5f8", zorder=0)
        for code, color in REASON_COLORS.items():
            bars = [(start, max(length, least)) for start, length in spans(time, codes == code)]
            if bars:
                ax.broken_barh(bars, (row - 0.36, 0.72), facecolors=color, linewidth=0)
    style.dress(ax, "time (s)", "")
    ax.grid(False, axis="y")
    ax.set_yticks(range(len(rows)), [f"{name}, {kind}" for name, kind, _ in rows], fontsize=10.0)
    ax.set_ylim(len(rows) - 0.4, -0.6)
    share = 100.0 * float(((position != 0) | (orientation != 0)).mean())
    ax.set_title(f"held back: {share:.2g} % of poses", fontsize=style.LABEL, color=style.INK, loc="left", pad=6)
    used = [code for code in REASON_COLORS if (position == code).any() or (orientation == code).any()]
    if used:
        keys = [Patch(color=REASON_COLORS[code], label=code.name.lower().replace("_", " ")) for code in used]
        look = {"frameon": False, "fontsize": style.TICK, "labelcolor": style.INK, "borderpad": 0.1}
        ax.figure.legend(handles=keys, loc="outside lower center", ncols=min(len(keys), 4), **look)
