"""Figures of the kinematic simulation, section V-A: the four-way panel, the estimates, the sensors' residuals."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from torch import Tensor

from apcc_torch.errors import ShapeError
from apcc_torch.model.kinematic_model import KinematicModel
from apcc_torch.report import style
from apcc_torch.report.backbone_drawing import (
    Snapshots,
    draw_views,
    marker_positions,
    space_key,
    span_text,
    spread_indices,
)
from apcc_torch.report.space import Space, bounding_box
from apcc_torch.report.style import Array, values
from apcc_torch.shapes import check_tensor
from apcc_torch.simulation.kinematic import KinematicLog
from apcc_torch.simulation.metrics import backbone_error

TIME = "time (s)"
INSTANTS = 400
"""At which rows in the background are drawn."""
PALE: dict[str, Any] = {"linewidth": 0.7, "alpha": 0.35, "zorder": 1.2}
"""Look of rows in the background."""


def select_row(log: KinematicLog, index: int | tuple[int, ...]) -> KinematicLog:
    """One row of a batched log: time first, no batch dimension left. The shared time stays."""
    at: tuple[slice | int, ...] = (slice(None), *(index if isinstance(index, tuple) else (index,)))
    return KinematicLog(log.time, *(field[at] for field in log[1:]))


def check_row(log: KinematicLog, pi: Tensor, backbone: KinematicModel) -> None:
    """Raises ShapeError where the log is not one row's, or does not fit the arm."""
    T = len(check_tensor("log.time", log.time, (None,)))
    for name, width in (("x_d", 3), ("x", 3), ("q_true", backbone.n), ("q_bar", backbone.n)):
        _one_row(f"log.{name}", getattr(log, name), T, width)
    _one_row("log.pi_hat", log.pi_hat, T, backbone.n_sections)
    check_tensor("pi", pi, (backbone.n_sections,))


def _one_row(name: str, field: Tensor, T: int, width: int) -> None:
    if field.shape != (T, width):
        raise ShapeError(f"{name} must have shape {(T, width)}, one row's, got {tuple(field.shape)}")


def snapshots(
    log: KinematicLog, pi: Tensor, abscissae: Tensor, backbone: KinematicModel, end: float, count: int, points: int = 90
) -> Snapshots:
    """Moments of one row's log, spread over [0, end] s; arguments as `convergence_figure`."""
    at = torch.tensor(spread_indices(log.time, float(log.time[0]), end, count), device=log.time.device)
    q_true, q_bar, pi_hat = log.q_true[at], log.q_bar[at], log.pi_hat[at]
    return Snapshots(
        log.time[at],
        backbone.points(q_true, pi, points),
        backbone.points(q_bar, pi_hat, points),
        marker_positions(backbone, q_true, pi, abscissae),
        marker_positions(backbone, q_bar, pi_hat, abscissae),
    )


def convergence_figure(
    log: KinematicLog,
    pi: Tensor,
    abscissae: Tensor,
    backbone: KinematicModel,
    end: float = 3.0,
    count: int = 6,
    others: KinematicLog | None = None,
) -> Figure:
    """The four-way panel of the adaptive controller. Fig. 7 [Dalenberg].

    (a) the arm's first seconds as stroboscopic views: true system, virtual model with the sensors where algorithm 1
    puts them, overlap; (b) the end-effector error; (c) the total length; (d) the shape error, Eq. (52).

    Args:
        log: One row's log.
        pi: (n_b,) true rest lengths, m.
        abscissae: (k,) material abscissae of the sensors, m.
        backbone: The arm.
        end: Last moment of (a), s.
        count: Moments in (a).
        others: (T', R, ...) rows from other first estimates, drawn pale in (b) to (d).

    Raises:
        ShapeError, DtypeError: The log is not one row's, or an argument does not fit it.
    """
    check_row(log, pi, backbone)
    figure = style.new_figure(10.0, 7.4, constrained=False)
    shots = snapshots(log, pi, abscissae, backbone, end, count)
    _draw_space(figure, log, shots)
    lower = figure.add_gridspec(1, 3, left=0.085, right=0.985, bottom=0.085, top=0.36, wspace=0.42)
    panels = [figure.add_subplot(lower[0, c]) for c in range(3)]
    draw_tip_error(panels[0], log, others)
    draw_length(panels[1], log, pi, backbone, others)
    shape_error = backbone_error(backbone, log.q_true, pi, backbone, log.q_bar, log.pi_hat)
    draw_shape_error(panels[2], log, shape_error, others, (pi, backbone))
    for ax, title in zip(panels, ("(b) end-effector error", "(c) total length", "(d) shape error"), strict=True):
        ax.set_title(title, fontsize=style.TITLE, color=style.INK, loc="left", pad=8)
    return figure


def _draw_space(figure: Figure, log: KinematicLog, shots: Snapshots) -> None:
    grid = figure.add_gridspec(1, 3, left=0.005, right=0.995, bottom=0.435, top=0.875, wspace=0.03)
    box = bounding_box(values(shots.true_points), values(shots.model_points))
    spaces = [Space(figure.add_subplot(grid[0, c]), box) for c in range(3)]
    draw_views(spaces, shots, markers_on_true=False)
    path = values(log.x_d[log.time <= shots.time[-1]])
    for space, head in zip(spaces, ("true system", "virtual model", "overlap"), strict=True):
        space.plot(path, color=style.TARGET, linewidth=1.6, linestyle=":", zorder=4.0)
        space.ax.set_title(head, fontsize=style.LABEL, color=style.INK, pad=2)
    figure.text(0.012, 0.965, "(a)", fontsize=style.TITLE, color=style.INK)
    figure.text(0.052, 0.966, span_text(shots.time), fontsize=style.TICK, color=style.MUTED)
    figure.legend(
        handles=space_key(target=False, path=True), loc="upper right", ncols=4, frameon=False,
        fontsize=style.TICK, labelcolor=style.INK, bbox_to_anchor=(0.995, 1.0), columnspacing=1.2,
    )  # fmt: skip


def draw_tip_error(ax: Axes, log: KinematicLog, others: KinematicLog | None = None) -> None:
    """End-effector error norm in mm over time, logarithmic."""
    time, error = values(log.time), 1e3 * values((log.x_d - log.x).norm(dim=-1))
    every = [error]
    if others is not None:
        every.append(1e3 * values((others.x_d - others.x).norm(dim=-1)))
        ax.plot(values(others.time), every[1], color=style.MODEL, **PALE)
    ax.plot(time, error, color=style.MODEL, linewidth=style.LINE)
    style.dress(ax, TIME, r"$\|x_d - x\|$ (mm)")
    style.log_scale(ax, every)
    style.fit_time(ax, time)


def draw_length(
    ax: Axes, log: KinematicLog, pi: Tensor, backbone: KinematicModel, others: KinematicLog | None = None
) -> None:
    """Total lengths in m, of the true system and of the model."""
    time = values(log.time)
    if others is not None:
        theirs = values(backbone.section_lengths(others.q_bar, others.pi_hat).sum(-1))
        ax.plot(values(others.time), theirs, color=style.MODEL, **PALE)
    true = values(backbone.section_lengths(log.q_true, pi).sum(-1))
    model = values(backbone.section_lengths(log.q_bar, log.pi_hat).sum(-1))
    ax.plot(time, true, color=style.TRUE, linewidth=3.6, alpha=0.55, label="true system")
    ax.plot(time, model, color=style.MODEL, linewidth=1.6, label="virtual model")
    style.dress(ax, TIME, "total length (m)")
    style.fit_time(ax, time)
    low, high = ax.get_ylim()
    ax.set_ylim(low, high + 0.32 * (high - low))  # room for the legend
    ax.locator_params(axis="y", nbins=5)
    style.legend(ax, loc="upper right", fontsize=style.TICK)


def draw_shape_error(
    ax: Axes,
    log: KinematicLog,
    error: Tensor,
    others: KinematicLog | None = None,
    arm: tuple[Tensor, KinematicModel] | None = None,
) -> None:
    """Shape error in mm over time, logarithmic; `error` (T,) m, and of the others by the arm's lengths and model."""
    time, every = values(log.time), [1e3 * values(error)]
    if others is not None and arm is not None:
        pi, backbone = arm
        theirs = backbone_error(backbone, others.q_true, pi, backbone, others.q_bar, others.pi_hat)
        every.append(1e3 * values(theirs))
        ax.plot(values(others.time), every[1], color=style.MODEL, **PALE)
    ax.plot(time, every[0], color=style.MODEL, linewidth=style.LINE)
    style.dress(ax, TIME, r"$\mathcal{E}_{shape}$ (mm)")
    style.log_scale(ax, every)
    style.fit_time(ax, time)


def parameter_figure(log: KinematicLog, pi: Tensor, others: KinematicLog | None = None) -> Figure:
    """Estimates of the rest lengths against the true ones. Fig. 8 [Dalenberg].

    Args:
        log: One row's log.
        pi: (n_b,) true rest lengths, m.
        others: (T', R, ...) rows from other first estimates, drawn pale.
    """
    check_tensor("pi", pi, (log.pi_hat.shape[-1],))
    n_b = len(pi)
    figure = style.new_figure(10.0, 6.0 + 0.25 * max(0, n_b - 3))
    ax = figure.subplots()
    time, estimates = values(log.time), values(log.pi_hat)
    for i, true in enumerate(values(pi)):
        color = style.SERIES[i % len(style.SERIES)]
        name = rf"$\hat\pi_{{{i + 1}}}$, ends at {estimates[-1, i]:.4f} m; true {true:.4f} m"
        if others is not None:
            ax.plot(values(others.time), values(others.pi_hat[..., i]), color=color, **PALE)
        ax.plot(time, estimates[:, i], color=color, linewidth=2.4, label=name)
        ax.axhline(true, color=color, linewidth=1.5, linestyle=(0, (5, 3)))
    rows = _starts_told(others)
    title = f"estimated (solid) and true (dashed) rest lengths{rows}"
    style.dress(ax, TIME, r"rest length $\hat\pi_i$ (m)", title)
    style.fit_time(ax, time)
    low, high = ax.get_ylim()
    ax.set_ylim(low - 0.05 * (high - low), high + 0.05 * (high - low))
    style.legend(ax, loc="upper center", bbox_to_anchor=(0.5, -0.13), ncols=2)
    return figure


def _starts_told(others: KinematicLog | None) -> str:
    """How many rows are drawn pale, for a title."""
    count = 0 if others is None else others.pi_hat.shape[1]
    return "" if count == 0 else f"; pale: {count} other {'start' if count == 1 else 'starts'}"


def sensor_figure(log: KinematicLog, abscissae: Tensor, others: KinematicLog | None = None) -> Figure:
    """Residual norms of algorithm 2, angular and linear, per sensor. Fig. 9 [Dalenberg].

    Args:
        log: One row's log.
        abscissae: (k,) material abscissae of the sensors, m.
        others: (T', R, ...) rows from other first estimates, drawn pale.
    """
    check_tensor("abscissae", abscissae, (log.linear_error.shape[-1],))
    figure = style.new_figure()
    upper, lower = figure.subplots(2, 1, sharex=True)
    time = values(log.time)
    names = [f"sensor {k + 1} at {float(X):.3g} m" for k, X in enumerate(abscissae)]
    rows = _starts_told(others)
    for ax, field, scale in ((upper, "angular_error", 1e2), (lower, "linear_error", 1e3)):
        behind = None if others is None else (values(others.time), scale * values(getattr(others, field)))
        _draw_sensors(ax, time, scale * values(getattr(log, field)), names, behind)
    style.dress(upper, "", "angular error (crad)", f"sensor error norms{rows}")
    style.dress(lower, TIME, "linear error (mm)")
    style.fit_time(lower, time)
    style.legend(lower, loc="upper center", bbox_to_anchor=(0.5, -0.22), ncols=min(len(names), 4))
    return figure


def _draw_sensors(
    ax: Axes, time: Array, error: Array, names: Sequence[str], behind: tuple[Array, Array] | None
) -> None:
    every = [error]
    for k, name in enumerate(names):
        color = style.SERIES[k % len(style.SERIES)]
        if behind is not None:
            every.append(behind[1][..., k])
            ax.plot(behind[0], behind[1][..., k], color=color, **PALE)
        ax.plot(time, error[:, k], color=color, linewidth=1.7, label=name)
    style.log_scale(ax, every, decades=6.0)


def kinematic_figures(
    log: KinematicLog, pi: Tensor, abscissae: Tensor, backbone: KinematicModel
) -> dict[str, style.Draw]:
    """{file name: what draws it} of a run: its row 0, and pale behind it what its other rows do.

    Args:
        log: (T, R, ...), of R rows.
        pi: (n_b,) true rest lengths, m.
        abscissae: (k,) material abscissae of the sensors, m.
        backbone: The arm.
    """
    first, others = select_row(log, 0), None
    if log.q_bar.shape[1] > 1:
        stride = max(1, log.time.shape[0] // INSTANTS)
        others = KinematicLog(log.time[::stride], *(field[::stride, 1:] for field in log[1:]))
    return {
        "figure_7.png": lambda: convergence_figure(first, pi, abscissae, backbone, others=others),
        "figure_8.png": lambda: parameter_figure(first, pi, others),
        "figure_9.png": lambda: sensor_figure(first, abscissae, others),
    }
