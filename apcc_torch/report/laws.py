"""Laws of the rest lengths beside each other: shape error over elongation, a panel a run."""

from __future__ import annotations

from collections.abc import Mapping

from matplotlib.figure import Figure
from matplotlib.ticker import NullLocator

from apcc_torch.report.style import SERIES, dress, legend, new_figure

MARKERS = ("o", "v", "^", "D", "s", "P", "X")


def law_figure(runs: Mapping[str, Mapping[str, tuple[float, float]]], title: str) -> Figure:
    """A panel a run: mean shape error over mean Psi, a marker a law; both axes are logarithmic, for some laws run away.

    Args:
        runs: Run -> law -> (shape error mm, Psi cm).
        title: Of the first panel, before its run's name.
    """
    figure = new_figure(4.6 * len(runs), 4.6)
    axes = figure.subplots(1, len(runs), squeeze=False)[0]
    for ax, (run, laws) in zip(axes, runs.items(), strict=True):
        for i, (law, (shape, psi)) in enumerate(laws.items()):
            marker = MARKERS[i % len(MARKERS)]
            ax.plot([psi], [shape], marker, color=SERIES[i % len(SERIES)], markersize=10, label=law)
        dress(ax, r"mean $\Psi$ (cm)", "mean shape error (mm)", f"{title}{run}")
        for axis, scale in ((ax.xaxis, ax.set_xscale), (ax.yaxis, ax.set_yscale)):
            scale("log")
            axis.set_major_formatter("{x:g}")
            axis.set_minor_locator(NullLocator())
    legend(axes[0], loc="best")
    return figure
