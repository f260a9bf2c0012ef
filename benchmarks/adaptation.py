"""The study of the laws: `python benchmarks/adaptation.py` writes adaptation.json and docs/images/adaptation.png.

Section V-B's arm under poses, three of the training set-points by three payloads, 6 s. One thing is changed at a time,
for the fixed model and for each law. About ten minutes on two cores.
"""

from __future__ import annotations

import argparse
import json
import multiprocessing
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path

import torch
from apcc_torch.control.length_bank import LengthBankSettings
from run_settings import BANK, GENTLE, run_settings
from sections import SECTIONS, with_sections
from tqdm import tqdm

from apcc_torch.experiments.dynamic import curves, dynamic_metrics, simulate, thinned
from apcc_torch.files import write_json
from apcc_torch.report.style import SERIES, dress, new_figure, save_figure

BASE = ("experiment=dynamic_run_2_tuned", "experiment.subset=training", "experiment.duration=6.0", *GENTLE)
TASK = ("residual=none", "adaptation.gamma=24.5", "adaptation.gain_scale=0.02", "adaptation.rate=0.1",
        "adaptation.dead_zone=0.002")  # fmt: skip
LAWS: dict[str, tuple[str, ...]] = {
    "fixed": ("controller.adaptive=false",),
    "task error, partial": ("adaptation=partial", *TASK),
    "task error, total": ("adaptation=estimator_aware", *TASK),
    "joint": ("residual.target=sensors", "residual.angular_weight=0.03", "residual.memory=0.5",
              "residual.nominal_weight=0.05", "residual.elongation_weight=0.05", "residual.time_constant=0.3"),
    "curve": ("residual.time_constant=0.3", "residual.nominal_weight=0.02", "residual.elongation_weight=0.05"),
    "bank": BANK,
}  # fmt: skip
TASK_LAWS = ("task error, partial", "task error, total")
FEW = ("fixed", "task error, total", "curve", "bank")
SENSORS = {
    1: "[0.6]", 2: "[0.36,0.6]", 3: "[0.105,0.36,0.6]", 4: "[0.105,0.2325,0.36,0.6]", 5: "[0.105,0.2325,0.36,0.48,0.6]",
}  # fmt: skip


def studies() -> dict[str, tuple[str, tuple[str, ...], dict[float, tuple[str, ...]]]]:
    """Study -> (axis, laws, {value: overrides})."""

    def over(*values: float, key: str) -> dict[float, tuple[str, ...]]:
        return {value: (f"{key}={value}",) for value in values}

    rates = {float(r): (f"controller.rate={r}", f"plant.substeps={max(1, 200 // r)}") for r in (50, 100, 200)}
    delays = {float(10 * d): (f"sensors.delay={d}",) for d in (0, 2, 4)}
    noises = {1e3 * n: (f"sensors.position_noise={n}", "sensors.angular_noise=0.0087") for n in (0.0, 2e-4, 1e-3)}
    gains = {
        "task error, partial": "adaptation.gain_scale", "task error, total": "adaptation.gain_scale",
    }  # fmt: skip
    found = {
        "window": ("window N of the velocity filter", TASK_LAWS,
                   {float(n): (f"velocity_filter.window={n}",) for n in (5, 15, 50, 200)}),
        "order": ("order of the velocity filter", TASK_LAWS,
                  {float(n): (f"velocity_filter.order={n}", "velocity_filter.window=25") for n in (1, 2, 3)}),
        "rate": ("control rate (Hz)", FEW, rates),
        "gain": ("gain, 1 is the paper's", tuple(gains), over(0.01, 0.1, 1.0, key="adaptation.gain_scale")),
        "hold": ("hold on the nominal lengths, kappa", ("curve", "bank", "joint"),
                 over(0.002, 0.02, 0.05, 0.2, key="residual.nominal_weight")),
        "price": ("weight of elongation, mu", ("curve", "bank"),
                  over(0.0, 0.05, 0.2, key="residual.elongation_weight")),
        "noise": ("position noise (mm), with 0.5 degrees", FEW, noises),
        "delay": ("delay of the sensors (ms)", FEW, delays),
        "sensors": ("sensors", FEW, {float(k): (f"arm.sensors={v}",) for k, v in SENSORS.items()}),
        "sections": ("sections of the model", FEW,
                     {float(k): with_sections(v) for k, v in SECTIONS.items()}),
        "payload": ("payload (kg)", FEW, {p: (f"experiment.payloads=[{p}]",) for p in (0.0, 0.25, 0.5)}),
    }  # fmt: skip
    return found


def measured(overrides: tuple[str, ...]) -> dict[str, float] | None:
    """The metrics of one setting; None where the law does not take it."""
    torch.set_num_threads(1)
    config = run_settings(*BASE, *overrides)
    bank = isinstance(config.residual, LengthBankSettings)
    if bank and len(config.arm.sensor_places()) < config.arm.n_sections:
        return None  # which a bank refuses
    # It goes where its models are; the other laws stay within a quarter of the nominal lengths.
    bounds = config.bounds.changed(lower=None if bank else 0.75, upper=None if bank else 1.25)
    few = config.experiment.changed(setpoints=(config.experiment.setpoints or ())[:6])  # three are training ones
    log, arms = simulate(config.changed(bounds=bounds, experiment=few))
    thin = thinned(log, 60)
    wanted = ("shape_error_mean_mm", "shape_error_max_mm", "psi_mean_cm", "end_effector_error_end_mm", "diverged_rows")
    metrics = dynamic_metrics(curves(thin, arms))
    return {name: metrics[name] for name in wanted}


def draw(results: dict[str, dict[str, dict[str, dict[str, float]]]], path: Path) -> None:
    """One panel a study: mean shape error against what is changed, a line a law; a cross where rows diverged."""
    table = studies()
    figure = new_figure(13.0, 11.0)
    axes = figure.subplots(4, 3).flat
    colours = dict(zip(LAWS, SERIES, strict=True))
    for ax, (name, laws) in zip(axes, results.items(), strict=False):
        every: list[float] = []
        for law, points in laws.items():
            x = [float(value) for value in points]
            y = [point["shape_error_mean_mm"] for point in points.values()]
            ax.plot(x, y, "o-", color=colours[law], label=law, linewidth=2.0, markersize=4)
            bad = [(a, b) for a, b, p in zip(x, y, points.values(), strict=True) if p["diverged_rows"] > 0]
            if bad:
                ax.plot(*zip(*bad, strict=True), "x", color=colours[law], markersize=10, markeredgewidth=2.5)
            every += y
        if name in ("window", "gain", "hold"):
            ax.set_xscale("log")
        if max(every) > 15.0:
            ax.set_yscale("log")
        else:
            ax.set_ylim(0.0, 1.1 * max(every))
        dress(ax, table[name][0], "shape error (mm)")
    handles = {h.get_label(): h for ax in figure.axes for h in ax.get_lines() if h.get_label() in LAWS}
    last = figure.axes[-1]
    last.axis("off")
    last.legend(handles=[handles[law] for law in LAWS if law in handles], loc="center", fontsize=13, frameon=False)
    save_figure(figure, path)


def main() -> None:
    """Runs the study, or draws it again from its numbers."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", default="adaptation.json", help="where the numbers go (default: %(default)s)")
    parser.add_argument("--figure", default="docs/images/adaptation.png", help="the figure (default: %(default)s)")
    parser.add_argument("--only", nargs="*", help="some of the studies: " + ", ".join(studies()))
    parser.add_argument("--draw", action="store_true", help="only draw, from the file of --out")
    parser.add_argument("--workers", type=int, default=2, help="processes (default: %(default)s)")
    options = parser.parse_args()
    chosen = {name: study for name, study in studies().items() if not options.only or name in options.only}
    if options.draw:
        draw(json.loads(Path(options.out).read_text(encoding="utf-8")), Path(options.figure))
        return
    tasks = [
        (name, law, f"{value:g}", (*LAWS[law], *overrides))
        for name, (_, laws, values) in chosen.items()
        for law in laws
        for value, overrides in values.items()
    ]
    results: dict[str, dict[str, dict[str, dict[str, float]]]] = {}
    with ProcessPoolExecutor(options.workers, multiprocessing.get_context("spawn")) as pool:
        found = pool.map(measured, [task[-1] for task in tasks])
        for (name, law, value, _), metrics in zip(tasks, tqdm(found, total=len(tasks), desc="settings"), strict=True):
            if metrics is not None:
                results.setdefault(name, {}).setdefault(law, {})[value] = metrics
            write_json(options.out, results)
    draw(results, Path(options.figure))


if __name__ == "__main__":
    main()
