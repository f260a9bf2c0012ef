"""Shape against elongation: what any rest lengths could reach, and where each controller stands."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import NamedTuple

from matplotlib.figure import Figure
from matplotlib.ticker import NullLocator

from apcc_torch.report.style import CONTROLLERS, INK, WIDEST, dress, figure_legend, from_zero, new_figure

Pair = tuple[float, float]

TICKS = (0.5, 1, 2, 3, 5, 10, 20, 30, 50, 100)
"""cm, where a logarithmic axis is labelled."""


class TradeOff(NamedTuple):
    """One run.

    fronts: Controller -> (shape error mm, Psi cm) of the best rest lengths on its motion, price by price. least: The
    limit of the shape error on the first one's motion, mm. reached: Controller -> what it reached.
    """

    fronts: Mapping[str, Sequence[Pair]]
    least: float
    reached: Mapping[str, Pair]


def trade_off_figure(runs: Mapping[str, TradeOff]) -> Figure:
    """A panel a run: mean shape error over mean Psi."""
    figure = new_figure(min(4.6 * len(runs), WIDEST), 5.2)
    axes = figure.subplots(1, len(runs), squeeze=False)[0]
    for ax, (title, run) in zip(axes, runs.items(), strict=True):
        for name, front in run.fronts.items():
            shape, psi = zip(*front, strict=True)
            label = f"any rest lengths, {name} motion"
            ax.plot(psi, shape, ".-", color=CONTROLLERS[name], linewidth=1.5, markersize=6, label=label)
        ax.axhline(run.least, color=INK, linewidth=1.0, linestyle=":", label="best three arcs")
        for name, (error, elongation) in run.reached.items():
            ax.plot(elongation, error, "o", color=CONTROLLERS[name], markersize=10, label=name)
        dress(ax, r"mean $\Psi$ (cm)", "mean shape error (mm)" if ax is axes[0] else "", title)
        every = [psi for pairs in (*run.fronts.values(), run.reached.values()) for _, psi in pairs]
        low, high = min(every), max(every)
        if high > 3.0 * low:
            ax.set_xscale("log")
            ax.set_xticks(spaced([tick for tick in TICKS if 0.9 * low < tick < 1.1 * high], 5))
            ax.xaxis.set_major_formatter("{x:g}")
            ax.xaxis.set_minor_locator(NullLocator())
        from_zero(ax)
    figure_legend(figure, axes[0], loc="outside lower center", ncols=2)
    return figure


def spaced(ticks: Sequence[float], most: int) -> list[float]:
    """At most so many of the ticks, evenly chosen, the first among them."""
    return list(ticks[:: -(-len(ticks) // most)]) if ticks else []
