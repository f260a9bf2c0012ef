"""The arm and its model in one plane at the end of a run, and the end-effector error on the way there."""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np
from matplotlib.figure import Figure
from torch import Tensor

from apcc_torch.report import style
from apcc_torch.report.dynamic import TIME, Runs, check_runs
from apcc_torch.report.style import values


class Overlay(NamedTuple):
    """One moment, world frame, m.

    curve: (N, 3) a smooth curve through what was measured of the true arm. sensors: (k, 3) measured. model: (M, 3)
    along the virtual model. target: (3,).
    """

    curve: Tensor
    sensors: Tensor
    model: Tensor
    target: Tensor


def overlay_figure(moments: Mapping[str, Overlay]) -> Figure:
    """True system and virtual model in the YZ plane, a panel a controller. Figs. 27, 31 [Dalenberg]."""
    figure = style.new_figure(min(4.8 * len(moments), style.WIDEST), 6.0)
    axes = figure.subplots(1, len(moments), squeeze=False, sharex=True, sharey=True)[0]
    for ax, (name, moment) in zip(axes, moments.items(), strict=True):
        curve = np.concatenate((np.zeros((1, 3)), values(moment.curve)))
        model, sensors, target = values(moment.model), values(moment.sensors), values(moment.target)
        ax.plot(curve[:, 1], curve[:, 2], color=style.TRUE, linewidth=6.0, alpha=0.5, label="true system")
        ax.plot(model[:, 1], model[:, 2], color=style.MODEL, linewidth=1.8, label="virtual model")
        dot = {"linestyle": "none", "markeredgecolor": "white"}
        ax.plot(sensors[:, 1], sensors[:, 2], marker="o", color=style.SENSOR, label="sensors", **dot)
        ax.plot(target[1], target[2], marker="*", markersize=15, color=style.TARGET, label="target", **dot)
        style.dress(ax, "y (m)", "z (m)" if ax is axes[0] else "", name)
        ax.locator_params(nbins=5)
        ax.set_aspect("equal", adjustable="box")
    style.figure_legend(figure, axes[0], loc="outside upper center")
    return figure


def error_figure(runs: Runs, arrival: float) -> Figure:
    """End-effector error in mm, each run to its end, which a dashed line marks. Figs. 28, 32, 36 [Dalenberg].

    Args:
        runs: Controllers and their single runs.
        arrival: The error at which a run counts as arrived, m.
    """
    check_runs(runs)
    figure = style.new_figure(10.0, 4.2)
    ax = figure.subplots()
    for index, (name, curves) in enumerate(runs.items()):
        time, error = values(curves.time), 1e3 * values(curves.e)[:, 0]
        color = style.controller_color(name, index)
        ax.plot(time, error, color=color, linewidth=style.LINE, label=f"{name}, {time[-1]:.2f} s")
        ax.axvline(time[-1], color=color, linewidth=1.2, linestyle=style.DASHES[1])
    ax.axhline(1e3 * arrival, color=style.MUTED, linewidth=1.0, linestyle=style.DASHES[2])
    style.log_scale(ax, [1e3 * values(curves.e) for curves in runs.values()])
    style.dress(ax, TIME, "end-effector error (mm)")
    style.legend(ax)
    return figure
