"""Figures of an identification: the models' errors, prediction over measurement, residuals, parameters."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np
from matplotlib.figure import Figure
from torch import Tensor

from apcc_torch.identification.intervals import Interval
from apcc_torch.report import style
from apcc_torch.report.style import Array, values

LABELS = {
    "mean": "constant mean",
    "linear": "linear regression",
    "linear_few": "linear, few samples",
    "pcc_nominal": "PCC as built",
    "pcc_identified": "PCC identified",
    "pcc_online": "PCC online",
    "arm_nominal": "arm as built",
    "arm_identified": "arm identified",
}
COLORS = {"linear": style.VERMILION, "arm_identified": style.BLUE}
ARROWS = 150
"""Residuals drawn as arrows."""
PARTS = 10
"""Stretches of the held-back samples whose spread the error bars show."""


class Outcome(NamedTuple):
    """What is drawn.

    measured: (N, k, 3) m. predicted: Model -> (N, k, 3) m, NaN where it says nothing.
    validation: (M,) indices held back.
    q: (N, 3 n_b) of the identified arm, rad and m. parameters: The fitted parameters.
    """

    measured: Tensor
    predicted: Mapping[str, Tensor]
    validation: Tensor
    q: Tensor
    parameters: Sequence[Interval]


def identification_figures(outcome: Outcome, length: float, title: str) -> dict[str, style.Draw]:
    """File name -> what draws it.

    Args:
        outcome: What is drawn.
        length: The arm's length, mm.
        title: Of the arm.
    """
    return {
        "models.png": lambda: models_figure(outcome, length, title),
        "prediction.png": lambda: prediction_figure(outcome, title),
        "residual.png": lambda: residual_figure(outcome, title),
        "parameters.png": lambda: parameters_figure(outcome.parameters, title),
    }


def _squared(outcome: Outcome, model: str) -> Array:
    """Squared tip error of each held-back sample (M,), mm^2; NaN where the model says nothing."""
    index = outcome.validation
    return 1e6 * values((outcome.measured[index, -1] - outcome.predicted[model][index, -1]).square().sum(-1))


def models_figure(outcome: Outcome, length: float, title: str) -> Figure:
    """Tip error of every model on what was held back; bars span the stretches of it, a tenth each."""
    figure = style.new_figure(9.0, 0.55 * len(outcome.predicted) + 1.6)
    ax = figure.subplots()
    for row, model in enumerate(outcome.predicted):
        squares = _squared(outcome, model)
        squares = squares[np.isfinite(squares)]
        whole = float(np.sqrt(squares.mean()))
        stretches = [float(np.sqrt(part.mean())) for part in np.array_split(squares, PARTS) if part.size]
        reach = [[max(whole - min(stretches), 0.0)], [max(max(stretches) - whole, 0.0)]]
        color = COLORS.get(model, style.EDGE)
        ax.barh(row, whole, color=color, height=0.62)
        ax.errorbar(whole, row, xerr=reach, color=style.INK, capsize=3, linewidth=1.2)
        text = f" {style.digits(whole)} mm, {style.digits(100.0 * whole / length)} %"
        ax.text(max(stretches), row, text, va="center", fontsize=style.TICK, color=style.INK)
    ax.set_yticks(range(len(outcome.predicted)), [LABELS[model] for model in outcome.predicted])
    ax.invert_yaxis()
    style.dress(ax, "tip error on held-back samples, root mean square (mm)", "", title)
    ax.grid(False, axis="y")
    ax.set_xlim(0.0, 1.3 * ax.get_xlim()[1])
    return figure


def prediction_figure(outcome: Outcome, title: str) -> Figure:
    """The tip's coordinates over the held-back samples: measured, by linear regression, by the identified arm."""
    figure = style.new_figure(10.0, 7.0)
    axes = figure.subplots(3, 1, sharex=True)
    index = outcome.validation
    # Between stretches that were held back the samples jump: a gap in the line says so.
    gaps = np.flatnonzero(np.diff(values(index)) > 1) + 1
    place = np.insert(np.arange(len(index), dtype=float), gaps, np.nan)
    for c, ax in enumerate(axes):
        lines = {"measured": (outcome.measured, style.INK, 2.4)}
        lines |= {LABELS[m]: (outcome.predicted[m], COLORS[m], 1.5) for m in COLORS}
        for label, (positions, color, width) in lines.items():
            drawn = np.insert(1e3 * values(positions[index, -1, c]), gaps, np.nan)
            ax.plot(place, drawn, color=color, linewidth=width, label=label)
        style.dress(ax, "" if c < 2 else "held-back sample", f"tip {'xyz'[c]} (mm)", title if c == 0 else "")
        ax.margins(x=0.01)
    style.legend(axes[0], loc="lower right", bbox_to_anchor=(1.0, 1.0), ncols=3)
    return figure


def residual_figure(outcome: Outcome, title: str) -> Figure:
    """Where in the workspace the identified arm is wrong, which way, and at which bend; held-back samples only."""
    figure = style.new_figure(10.0, 4.4)
    plane, side, bend = figure.subplots(1, 3)
    index = outcome.validation
    at = 1e3 * values(outcome.measured[index, -1])
    wrong = 1e3 * values(outcome.measured[index, -1] - outcome.predicted["arm_identified"][index, -1])
    size = np.linalg.norm(wrong, axis=-1)
    shown = np.unique(np.linspace(0, len(at) - 1, min(len(at), ARROWS)).astype(int))
    for ax, (i, j) in ((plane, (0, 1)), (side, (0, 2))):
        # Arrows at their true length would be too short to see; three times as long they show a pattern.
        start, along = at[shown], 3.0 * wrong[shown]
        arrows = ax.quiver(start[:, i], start[:, j], along[:, i], along[:, j], size[shown], cmap="viridis",
                           angles="xy", scale_units="xy", scale=1.0, width=0.006)  # fmt: skip
        ends = np.concatenate((start, start + along))
        ax.plot(ends[:, i], ends[:, j], linestyle="none")  # so that the axes hold every arrow whole
        style.dress(ax, f"tip {'xyz'[i]} (mm)", f"tip {'xyz'[j]} (mm)")
        ax.set_aspect("equal", adjustable="datalim")
    plane.set_title(f"{title}: residuals, 3 times their length", fontsize=style.LABEL, color=style.INK, loc="left")
    figure.colorbar(arrows, ax=side, label="residual (mm)", shrink=0.8)
    turned = values(outcome.q[index].unflatten(-1, (-1, 3))[..., :2].norm(dim=-1).sum(-1))
    bend.plot(turned, size, "o", color=style.BLUE, markersize=3.0, alpha=0.6)
    style.dress(bend, "bend of all sections (rad)", "residual (mm)")
    style.from_zero(bend)
    return figure


def parameters_figure(parameters: Sequence[Interval], title: str) -> Figure:
    """Every parameter's 95 % interval relative to its nominal value, and the share of the variance that was learned."""
    figure = style.new_figure(10.0, 0.24 * len(parameters) + 1.4)
    ax, learned = figure.subplots(1, 2, width_ratios=(3, 1), sharey=True)
    for row, p in enumerate(parameters):
        half = 0.5 * (p.high - p.low)
        # In half-widths of its own interval: how far the fit moved a parameter, against how well it knows it.
        ax.plot([(p.low - p.nominal) / half, (p.high - p.nominal) / half], [row, row], color=style.BLUE, linewidth=2.0)
        ax.plot((p.value - p.nominal) / half, row, "o", color=style.BLUE, markersize=3.5)
    learned.barh(range(len(parameters)), [100.0 * p.learned for p in parameters], color=style.EDGE, height=0.7)
    ax.axvline(0.0, color=style.INK, linewidth=1.0)
    ax.set_yticks(range(len(parameters)), [p.name for p in parameters])
    ax.invert_yaxis()
    style.dress(ax, "distance from nominal (half-widths of the 95 % interval)", "", title)
    style.dress(learned, "variance removed (%)")
    learned.set_xlim(0.0, 100.0)
    ax.tick_params(axis="y", labelsize=10.0)
    ax.set_ylim(len(parameters) - 0.4, -0.6)
    return figure
