"""Which window N? `python benchmarks/window.py`, a few minutes: section V-A over N, rate and sensors, as one figure.

The combinations are those of `sweep=window`; here the windows run side by side as rows of one batch. It prints a table
and writes docs/images/window.png.
"""

from __future__ import annotations

import argparse
from pathlib import Path

from matplotlib.figure import Figure
from matplotlib.ticker import FixedLocator, NullLocator

from apcc_torch.composed import compose
from apcc_torch.composition.stacking import stacked
from apcc_torch.experiments.kinematic import metrics, one_of, simulate
from apcc_torch.report.style import dress, from_zero, new_figure, save_figure

WINDOWS = (5, 9, 15, 25, 45)
RATES = {50: "#4c72b0", 100: "#dd8452", 200: "#55a868"}
SENSORS = {"perfect": "-", "mocap": "--"}
PANELS = {
    "velocity_lag_ms": "lag of the velocity (ms)",
    "velocity_noise_mmps": "noise of the velocity (mm/s)",
    "end_effector_error_last5s_max_mm": "tip error, largest (mm)",
    "shape_error_last5s_max_mm": "shape error, largest (mm)",
}
Measured = dict[tuple[str, int, int], dict[str, float]]


def measure() -> Measured:
    """(sensors, rate, window) -> metrics."""
    found: Measured = {}
    for sensors in SENSORS:
        for rate in RATES:
            words = ("experiment=kinematic", f"sensors={sensors}", f"controller.rate={rate}", "compile=aot")
            configs = [compose(*words, f"velocity_filter.window={window}").settings for window in WINDOWS]
            outcome = simulate(stacked(configs), len(configs))
            for p, window in enumerate(WINDOWS):
                found[sensors, rate, window] = metrics(one_of(outcome, configs[p], p))
    return found


def drawn(found: Measured) -> Figure:
    """A panel a measure, over the window."""
    figure = new_figure(9.0, 6.4)
    panels = figure.subplots(2, 2).flat
    for ax, (name, title) in zip(panels, PANELS.items(), strict=True):
        # Beside noise a lag of a few ms cannot be told.
        shown = {"perfect": "-"} if "lag" in name else SENSORS
        for sensors, style in shown.items():
            for rate, color in RATES.items():
                y = [found[sensors, rate, window][name] for window in WINDOWS]
                label = f"{rate} Hz, {'with noise' if sensors == 'mocap' else 'no noise'}"
                ax.plot(WINDOWS, y, style, marker="o", markersize=4, color=color, label=label)
        dress(ax, "window N (samples)", "", title)
        ax.set_xscale("log")
        ax.xaxis.set_major_locator(FixedLocator(WINDOWS))
        ax.xaxis.set_major_formatter("{x:g}")
        ax.xaxis.set_minor_locator(NullLocator())
        if "noise" in name:
            ax.set_yscale("log")
        elif "error" in name:
            from_zero(ax)
    figure.legend(*ax.get_legend_handles_labels(), loc="outside lower center", ncols=3, frameon=False)
    return figure


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    figure = Path(__file__).resolve().parents[1] / "docs" / "images" / "window.png"
    parser.add_argument("--out", type=Path, default=figure, help="the figure's file")
    given = parser.parse_args()
    table = measure()
    print("sensors  rate  N  " + "  ".join(PANELS))
    for (sensors, rate, window), row in table.items():
        print(f"{sensors:8} {rate:4} {window:3}  " + "  ".join(f"{row[name]:{len(name)}.3g}" for name in PANELS))
    save_figure(drawn(table), given.out)
