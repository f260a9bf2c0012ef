"""Laws of the rest lengths beside each other: shape error over elongation, a panel a run."""

from __future__ import annotations

from collections.abc import Mapping
from math import isfinite

from matplotlib.figure import Figure
from matplotlib.ticker import FixedLocator, NullLocator

from apcc_torch.report.style import INK, SERIES, WIDEST, dress, figure_legend, legend, new_figure
from apcc_torch.report.trade_off import TICKS, spaced

MARKERS = ("o", "v", "^", "D", "s", "P", "X")


def law_figure(runs: Mapping[str, Mapping[str, tuple[float, float]]], title: str) -> Figure:
    """A panel a run: mean shape error over mean Psi, a marker a law; both axes are logarithmic, for some laws run away.

    Args:
        runs: Run -> law -> (shape error mm, Psi cm), NaN of a law of which every run diverged.
        title: Of the first panel, before its run's name.
    """
    figure = new_figure(min(4.6 * len(runs), WIDEST), 4.6 + 0.28 * -(-len(next(iter(runs.values()))) // 2))
    axes = figure.subplots(1, len(runs), squeeze=False)[0]
    for ax, (run, laws) in zip(axes, runs.items(), strict=True):
        shapes, psis = ([pair[k] for pair in laws.values() if isfinite(pair[k])] for k in (0, 1))
        for i, (law, (shape, psi)) in enumerate(laws.items()):
            marker = MARKERS[i % len(MARKERS)]
            shown = any(isfinite(each[law][0]) for each in runs.values())
            label = law if shown else f"{law}: every run diverges"
            ax.plot([psi], [shape], marker, color=SERIES[i % len(SERIES)], markersize=10, label=label)
        dress(ax, r"mean $\Psi$ (cm)", "mean shape error (mm)" if ax is axes[0] else "", f"{title}{run}")
        if not shapes:
            continue
        ax.set_xscale("log")
        ax.set_yscale("log")
        for axis, values in ((ax.xaxis, psis), (ax.yaxis, shapes)):
            axis.set_major_locator(
                FixedLocator(spaced([tick for tick in TICKS if 0.7 * min(values) < tick < 1.4 * max(values)], 4))
            )
            axis.set_major_formatter("{x:g}")
            axis.set_minor_locator(NullLocator())
        ax.set_xlim(0.7 * min(psis), 1.4 * max(psis))
        ax.set_ylim(0.7 * min(shapes), 1.4 * max(shapes))
    figure_legend(figure, axes[0], loc="outside lower center", ncols=2)
    return figure


def regret_figure(runs: Mapping[str, tuple[float, float, float]]) -> Figure:
    """A line a run: the shape error of fixed lengths, of the best constant ones, and of the law.

    Args:
        runs: Run -> the three, mm.
    """
    figure = new_figure(7.2, 0.9 + 0.32 * len(runs))
    ax = figure.subplots()
    places = range(len(runs))
    names = ("fixed nominal lengths", "best constant lengths in hindsight", "the law")
    for i, (name, values) in enumerate(zip(names, zip(*runs.values(), strict=True), strict=True)):
        ax.plot(values, places, MARKERS[i], color=SERIES[i], markersize=8, label=name, zorder=3)
    for place, values in zip(places, runs.values(), strict=True):
        ax.plot([min(values), max(values)], [place, place], color=INK, linewidth=0.6, zorder=1)
    dress(ax, "mean shape error of the last 5 s (mm)", "", "")
    ax.set_xscale("log")
    every = [value for values in runs.values() for value in values]
    ax.xaxis.set_major_locator(FixedLocator([tick for tick in TICKS if 0.8 * min(every) < tick < 1.3 * max(every)]))
    ax.xaxis.set_major_formatter("{x:g}")
    ax.xaxis.set_minor_locator(NullLocator())
    ax.set_yticks(list(places), list(runs))
    ax.set_ylim(len(runs) - 0.4, -0.6)
    legend(ax, loc="lower center", bbox_to_anchor=(0.4, 1.0), ncols=3)
    return figure
