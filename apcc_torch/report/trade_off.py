"""Shape against elongation: what any rest lengths could reach, and where each controller stands."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import NamedTuple

from matplotlib.figure import Figure
from matplotlib.ticker import NullLocator

from apcc_torch.report.style import CONTROLLERS, INK, dress, from_zero, legend, new_figure

Pair = tuple[float, float]

TICKS = (1, 2, 3, 5, 10, 20, 30, 50, 100)
"""cm, where a logarithmic axis is labelled."""


class TradeOff(NamedTuple):
    """One run.

    front: (shape error mm, Psi cm) of the best rest lengths, price by price. least: The limit of the shape error, mm.
    reached: Controller -> what it reached.
    """

    front: Sequence[Pair]
    least: float
    reached: Mapping[str, Pair]


def trade_off_figure(runs: Mapping[str, TradeOff]) -> Figure:
    """A panel a run: mean shape error over mean Psi."""
    figure = new_figure(4.6 * len(runs), 4.4)
    axes = figure.subplots(1, len(runs), squeeze=False)[0]
    for ax, (title, run) in zip(axes, runs.items(), strict=True):
        shape, psi = zip(*run.front, strict=True)
        ax.plot(psi, shape, ".-", color=INK, linewidth=1.5, markersize=6, label="any rest lengths")
        ax.axhline(run.least, color=INK, linewidth=1.0, linestyle=":", label="best three arcs")
        for name, (error, elongation) in run.reached.items():
            ax.plot(elongation, error, "o", color=CONTROLLERS[name], markersize=10, label=name)
        dress(ax, r"mean $\Psi$ (cm)", r"mean shape error (mm)", title)
        if max(psi) > 3.0 * min(psi):
            ax.set_xscale("log")
            ax.set_xticks([tick for tick in TICKS if 0.9 * min(psi) < tick < 1.1 * max(psi)])
            ax.xaxis.set_major_formatter("{x:g}")
            ax.xaxis.set_minor_locator(NullLocator())
        from_zero(ax)
    legend(axes[0], loc="best")
    return figure
