"""Figures of the dynamic simulations, section V-B and appendix A: controllers compared over a grid of runs.

A line is the mean over the runs and its band reaches from their minimum to their maximum at each moment; a single run
has no band. Runs with a value that is not finite are left out, and a legend that counts fewer runs says so.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from torch import Tensor

from apcc_torch.errors import ShapeError, ValueRangeError
from apcc_torch.report import style
from apcc_torch.report.style import Array, values
from apcc_torch.shapes import check_tensor

TIME = "time (s)"
COLUMNS = 4
"""Panels side by side."""


class RunCurves(NamedTuple):
    """What R runs of one controller did, time first.

    time: (T,) s.
    shape_error: (T, R) m, Eq. (52) [Dalenberg].
    psi: (T, R) m, the secondary objective, Eq. (50).
    angular: (T, R, k) rad, and linear: (T, R, k) m: residual norms of algorithm 2 per sensor.
    e: (T, R) m, norm of the end-effector error.
    pi_hat: (T, R, n_b) m, parameter estimates.
    mapping_error: (T, R) m, Eq. (53).
    diverged: (T, R) int64, the causes by which a run has diverged until then; 0 for none.
    """

    time: Tensor
    shape_error: Tensor
    psi: Tensor
    angular: Tensor
    linear: Tensor
    e: Tensor
    pi_hat: Tensor
    mapping_error: Tensor
    diverged: Tensor

    def run(self, index: int) -> RunCurves:
        """One run alone, as curves of one run."""
        return RunCurves(self.time, *(field[:, index : index + 1] for field in self[1:]))


Runs = Mapping[str, RunCurves]
"""Controller name -> its runs; drawn in this order: {"standard": …, "adaptive": …}."""


class Band(NamedTuple):
    """Mean, minimum and maximum over the finite runs, each (T,), and how many of how many they were."""

    mean: Array
    low: Array
    high: Array
    counted: int
    total: int


def check_runs(runs: Runs) -> None:
    """Raises ShapeError or ValueRangeError where there is no controller, or a field does not fit the others."""
    if not runs:
        raise ValueRangeError("runs must name at least one controller, got none")
    for name, curves in runs.items():
        T = len(check_tensor(f"{name}.time", curves.time, (None,)))
        R = curves.e.shape[-1] if curves.e.dim() else 0
        for field in ("shape_error", "psi", "e", "mapping_error", "diverged"):
            _check_field(f"{name}.{field}", getattr(curves, field), (T, R))
        for field in ("angular", "linear", "pi_hat"):
            value = getattr(curves, field)
            _check_field(f"{name}.{field}", value, (T, R, value.shape[-1]))


def _check_field(name: str, value: Tensor, shape: tuple[int, ...]) -> None:
    if value.shape != shape:
        raise ShapeError(f"{name} must have shape {shape}, got {tuple(value.shape)}")


def band(data: Array) -> Band:
    """`Band` of runs (T, R).

    Raises:
        ValueRangeError: No run is finite.
    """
    finite: Array = np.atleast_1d(np.isfinite(data).all(axis=0))
    if not finite.any():
        raise ValueRangeError("data must hold at least one finite run, got none")
    kept = data[:, finite]
    return Band(kept.mean(1), kept.min(1), kept.max(1), int(finite.sum()), len(finite))


def draw_band(ax: Axes, time: Array, data: Array, color: str, label: str, dashes: Any = "-") -> Band:
    """Draws mean and band of runs (T, R); where runs were left out the label counts them."""
    drawn = band(data)
    if drawn.counted < drawn.total:
        label += f" ({drawn.counted} of {drawn.total} runs)"
    if drawn.counted > 1:
        ax.fill_between(time, drawn.low, drawn.high, color=color, alpha=0.17, linewidth=0)
        for edge in (drawn.low, drawn.high):
            ax.plot(time, edge, color=color, linewidth=0.7, alpha=0.55)
    ax.plot(time, drawn.mean, color=color, linewidth=2.2, linestyle=dashes, label=label)
    return drawn


def draw_curve(ax: Axes, runs: Runs, field: str, scale: float, unit: str) -> None:
    """Draws one scalar field of all controllers; the legend says each one's mean over time and runs."""
    for index, (name, curves) in enumerate(runs.items()):
        data = scale * values(getattr(curves, field))
        label = f"{name}, mean {style.digits(band(data).mean.mean())} {unit}"
        draw_band(ax, values(curves.time), data, style.controller_color(name, index), label)
    style.fit_time(ax, values(next(iter(runs.values())).time))


def time_label(runs: Runs) -> str:
    """The time axis's name, with what lines and bands are where there are bands."""
    most = max(curves.e.shape[1] for curves in runs.values())
    return TIME if most == 1 else f"{TIME}; lines are means, bands reach from the least to the largest of {most} runs"


def curve_figure(runs: Runs, field: str, scale: float, unit: str, name: str, title: str = "") -> Figure:
    """Mean and band of one scalar field of `RunCurves` over time.

    Args:
        runs: Controllers and their runs.
        field: "shape_error", "psi", "e" or "mapping_error".
        scale: The drawn unit's number per metre: 1e3 for mm.
        unit: The drawn unit.
        name: What the axis is called.
        title: Text over the axes.

    Raises:
        ShapeError, DtypeError, ValueRangeError: The runs do not fit each other, or none is finite.
    """
    check_runs(runs)
    figure = style.new_figure(10.0, 5.2)
    ax = figure.subplots()
    draw_curve(ax, runs, field, scale, unit)
    style.dress(ax, time_label(runs), f"{name} ({unit})", title)
    style.from_zero(ax)
    _legend_above(ax)
    return figure


def _legend_above(ax: Axes) -> None:
    """A legend over the axes, where no data can lie; beside the title, which is at the left."""
    style.legend(ax, loc="lower right", bbox_to_anchor=(1.0, 1.0), ncols=3, columnspacing=1.4, borderpad=0.2)


def shape_error_figure(runs: Runs, title: str = "") -> Figure:
    """Shape error in mm; of many runs or, after `RunCurves.run`, of one. Figs. 11, 15, 17, 40 [Dalenberg]."""
    return curve_figure(runs, "shape_error", 1e3, "mm", r"shape error $\mathcal{E}_{shape}$", title)


def psi_figure(runs: Runs, title: str = "") -> Figure:
    """Secondary objective in cm. Figs. 12, 18, 42 [Dalenberg]."""
    return curve_figure(runs, "psi", 1e2, "cm", r"secondary objective $\Psi$", title)


def mapping_error_figure(runs: Runs, title: str = "") -> Figure:
    """Actuation mismatch in cm, Eq. (53). Figs. 30, 34, 38 [Dalenberg]."""
    return curve_figure(runs, "mapping_error", 1e2, "cm", "actuation mismatch", title)


def parameter_figure(runs: Runs, title: str = "", true: Tensor | None = None) -> Figure:
    """Evolution of the estimates over the runs, one panel a section, against fixed ones. Fig. 13 [Dalenberg].

    Args:
        runs: Controllers and their runs; a controller that does not adapt is a level line.
        title: Text over the axes.
        true: (n_b,) m, the true rest lengths, drawn dotted; None where they are not known.
    """
    check_runs(runs)
    sections = next(iter(runs.values())).pi_hat.shape[-1]
    figure = style.new_figure(10.0, 0.9 + 1.75 * sections)
    panels = figure.subplots(sections, 1, sharex=True, squeeze=False)[:, 0]
    for i, ax in enumerate(panels):
        for index, (name, curves) in enumerate(runs.items()):
            data = values(curves.pi_hat[..., i])
            still = bool(np.nanmax(data) - np.nanmin(data) < 1e-9)
            label = f"{name}, fixed" if still else name
            color = style.controller_color(name, index)
            draw_band(ax, values(curves.time), data, color, label, (0, (5, 3)) if still else "-")
        if true is not None:
            ax.axhline(float(true[i]), color=style.INK, linewidth=1.6, linestyle=(0, (1, 1.6)), label="true length")
        style.dress(ax, "", rf"$\hat\pi_{{{i + 1}}}$ (m)")
        ax.margins(y=0.15)
        ax.locator_params(axis="y", nbins=5)
    panels[-1].set_xlabel(time_label(runs), fontsize=style.LABEL, color=style.INK)
    panels[0].set_title(title or "parameter estimates", fontsize=style.TITLE, color=style.INK, loc="left", pad=8)
    _legend_above(panels[0])
    style.fit_time(panels[-1], values(next(iter(runs.values())).time))
    return figure


def sensor_figure(runs: Runs, title: str = "", names: Sequence[str] | None = None) -> Figure:
    """Residual norms of algorithm 2 per sensor, angular (crad) over linear (cm). Figs. 16, 19, 43 [Dalenberg].

    A column a sensor, four at most in a row; the numbers in each panel are the controllers' means over time and runs.
    Units are smaller where these would show nothing.

    Args:
        runs: Controllers and their runs.
        title: Text over the figure.
        names: One a sensor; None numbers them.
    """
    check_runs(runs)
    sensors = next(iter(runs.values())).linear.shape[-1]
    heads = [f"sensor {s + 1}" for s in range(sensors)] if names is None else list(names)
    if len(heads) != sensors:
        raise ShapeError(f"names must have {sensors} entries, got {len(heads)}")
    columns = min(sensors, COLUMNS)
    blocks = -(-sensors // columns)
    figure = style.new_figure(10.0, 1.2 + 4.8 * blocks)
    panels = figure.subplots(2 * blocks, columns, sharex=True, squeeze=False)
    fields = (("angular", style.ANGLES, "crad"), ("linear", style.LENGTHS, "cm"))
    for f, (field, units, wanted) in enumerate(fields):
        unit = style.fitting(units, [values(getattr(curves, field)) for curves in runs.values()], wanted)
        row = [panels[2 * (s // columns) + f, s % columns] for s in range(sensors)]
        for s, ax in enumerate(row):
            for index, (name, curves) in enumerate(runs.items()):
                data = unit.per_si * values(getattr(curves, field)[..., s])
                color = style.controller_color(name, index)
                drawn = draw_band(ax, values(curves.time), data, color, name)
                _number(ax, f"{style.digits(drawn.mean.mean())} {unit.name}", color, index)
            label = f"{field} error ({unit.name})" if s % columns == 0 else ""
            style.dress(ax, TIME if f else "", label, "" if f else heads[s])
        top = max(ax.dataLim.y1 for ax in row)
        for s, ax in enumerate(row):
            ax.set_ylim(0.0, (1.15 + 0.2 * len(runs)) * top if top > 0 else 1.0)
            ax.locator_params(axis="y", nbins=5)
            ax.tick_params(labelleft=s % columns == 0)
    for s in range(sensors, blocks * columns):
        for f in range(2):
            panels[2 * (s // columns) + f, s % columns].set_axis_off()
    style.fit_time(panels[0, 0], values(next(iter(runs.values())).time))
    figure.get_layout_engine().set(wspace=0.06)  # type: ignore[union-attr,call-arg]
    most = max(curves.e.shape[1] for curves in runs.values())
    about = "means over time" if most == 1 else f"means over time and {most} runs; bands from the least to the largest"
    head = "; ".join(part for part in (title, about) if part)
    style.figure_legend(figure, panels[0, 0], loc="outside upper right", title=head)
    return figure


def _number(ax: Axes, text: str, color: str, index: int) -> None:
    ax.annotate(
        f"mean {text}", (0.98, 0.98), (0, -16 * index), xycoords="axes fraction", textcoords="offset points",
        ha="right", va="top", fontsize=style.TICK, color=color, fontweight="bold",
    )  # fmt: skip


def settling_times(time: Array, e: Array, tolerance: float) -> Array:
    """First time (R,) s after which each run's e (T, R) m stays within the tolerance; infinite where it never does."""
    inside = e <= tolerance
    stays = np.flip(np.logical_and.accumulate(np.flip(inside, 0), axis=0), 0)
    return np.where(stays.any(0), time[stays.argmax(0)], np.inf)


def end_effector_figure(runs: Runs, tolerance: float = 0.01, title: str = "") -> Figure:
    """End-effector error in mm over time, and the share of runs that have settled within a tolerance.

    Args:
        runs: Controllers and their runs; here a run that is not finite counts as one that never settles.
        tolerance: Error that counts as settled, m.
        title: Text over the left axes.
    """
    check_runs(runs)
    figure = style.new_figure(10.0, 5.2)
    left, right = figure.subplots(1, 2, width_ratios=(1.7, 1.0))
    draw_curve(left, runs, "e", 1e3, "mm")
    style.dress(left, TIME, "end-effector error (mm)", title or "end-effector error")
    style.log_scale(left, [1e3 * values(curves.e) for curves in runs.values()])
    left.axhline(1e3 * tolerance, color=style.MUTED, linewidth=1.0, linestyle=(0, (2, 2)))
    style.legend(left, loc="upper right")
    for index, (name, curves) in enumerate(runs.items()):
        time = values(curves.time)
        settled = settling_times(time, values(curves.e), tolerance)
        share = 100.0 * (settled[None] <= time[:, None]).mean(1)
        median = float(np.median(settled))
        label = f"{name}, median {style.digits(median)} s" if np.isfinite(median) else f"{name}, median never"
        right.plot(
            time, share, drawstyle="steps-post", color=style.controller_color(name, index), linewidth=2.2, label=label
        )
    style.dress(right, TIME, "settled runs (%)", f"settled within {1e3 * tolerance:g} mm")
    right.set_ylim(-3, 118)
    right.set_yticks(range(0, 101, 25))
    style.fit_time(right, values(next(iter(runs.values())).time))
    style.legend(right, loc="upper left")
    return figure
