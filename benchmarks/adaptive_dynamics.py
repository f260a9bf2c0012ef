"""What a model of the dynamics wins on section V-B: `python benchmarks/adaptive_dynamics.py`.

Run II's ten set-points by 0, 0.25 and 0.5 kg, 10 s each, under

  plain             the tendons' PID alone, as in the paper
  stiff             the same PID with four times the gains
  feed-forward      a feed-forward from fixed parameters: the arm is known, the payload is not
  tracking          its parameters adapt from the tracking error alone
  composite         they adapt from the tracking error and from the tendon forces
  known             the feed-forward of one who knows the payload: what is to be had

in several conditions: with and without adapting rest lengths, with the noise of motion capture at 50 Hz, with
rigidities believed 30 % too low, with a tendon friction believed half of what it is, with dry friction (a capstan's
coefficient of 0.1) that no parameter stands for, and at the paper's angular weight.

It prints a table, and writes adaptive_dynamics.json and docs/images/adaptive_dynamics.png. Each case is compiled once,
and kept; the first time takes about half an hour on one core. For a part: --only quiet noise.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from matplotlib.axes import Axes
from run_settings import run_settings
from torch import Tensor
from tqdm import tqdm

from apcc_torch.experiments.dynamic import Outcome, metrics, simulate
from apcc_torch.files import write_json
from apcc_torch.model.dynamics_regressor import PARAMETERS
from apcc_torch.report.dynamic import settling_times
from apcc_torch.report.style import SERIES, Array, dress, legend, log_scale, new_figure, save_figure, values

BASE = ("experiment=dynamic_run_2_tuned", "controller.null_gain=0.2", "controller.epsilon=0.005",
        "controller.adaptive=false", "compile=aot")  # fmt: skip
PAYLOADS = (0.0, 0.25, 0.5)
CONTROLLERS: dict[str, tuple[str, ...]] = {
    "plain": (),
    "stiff": ("plant.pid.K_P=3000", "plant.pid.K_I=4", "plant.pid.K_D=20"),
    "feed-forward": ("dynamics_law=feedforward",),
    "tracking": ("dynamics_law=composite", "dynamics_law.prediction=false", "dynamics_law.tracking_gain=30"),
    "composite": ("dynamics_law=composite",),
    "known": ("dynamics_law=feedforward",),
}
SOFT = ("dynamics_law.bending_rigidity=0.0545", "dynamics_law.axial_rigidity=7")
SLACK = ("dynamics_law.tendon_damping=100",)
FEW = ("plain", "feed-forward", "composite")
CONDITIONS: dict[str, tuple[tuple[str, ...], tuple[str, ...]]] = {
    "quiet": ((), tuple(CONTROLLERS)),
    "noise": (("sensors=mocap", "controller.rate=50", "plant.substeps=4"), FEW),
    "rest lengths adapt": (("controller.adaptive=true",), FEW),
    "rest lengths adapt, noise": (
        ("controller.adaptive=true", "sensors=mocap", "controller.rate=50", "plant.substeps=4"),
        ("plain", "composite"),
    ),
    "rigidities believed 30 % low": (SOFT, ("feed-forward", "composite")),
    "friction believed half": (SLACK, ("feed-forward", "composite")),
    "dry friction of 0.1": (
        (
            "plant.transmission.friction=0.1",
            "plant.transmission.slack=false",
        ),
        ("plain", "composite"),
    ),
    "1 m per rad": (("feedback.angular_weight=1.0",), FEW),
}
"""Condition -> (overrides, the controllers that are compared in it)."""


def measured(overrides: Sequence[str]) -> Outcome:
    """One run of the whole grid."""
    return simulate(run_settings(*BASE, *overrides))


def numbers(outcome: Outcome) -> dict[str, Any]:
    """What the table shows of runs, and curves over time for the figure."""
    log, arms = outcome
    e = values((log.x_d - log.x).norm(dim=-1))
    time = values(log.time)
    way = log.x_d[0] - log.x[0]
    past = ((log.x - log.x_d) * (way / way.norm(dim=-1, keepdim=True))).sum(-1).clamp(min=0.0).amax(0)
    found: dict[str, Any] = {name: metrics(outcome)[name] for name in (
        "shape_error_mean_mm", "shape_error_end_mm", "psi_mean_cm", "mapping_error_mean_mm", "diverged_rows",
        "tendon_force_rms_n", "tendon_force_max_n",
    )}  # fmt: skip
    for limit in (5, 2):
        times = settling_times(time, e, 1e-3 * limit)
        found[f"time_to_{limit}mm_median_s"] = [_finite(np.median(times[rows])) for rows in _by_payload(arms.theta)]
        found[f"within_{limit}mm_share"] = float(np.isfinite(times).mean())
    for instant in (2, 5, 10):
        found[f"tip_error_at_{instant}s_mm"] = 1e3 * float(e[np.searchsorted(time, instant - 1e-9)].mean())
    found["overshoot_mean_mm"] = 1e3 * float(past.mean())
    stride = max(1, (len(time) - 1) // 100)

    def curves(data: Array) -> list[list[float]]:
        return [data[::stride, rows].mean(1).tolist() for rows in _by_payload(arms.theta)]

    found["curves"] = {"time": time[::stride].tolist(), "e_mm": curves(1e3 * e)}
    if log.theta_hat.shape[-1]:
        estimate = values(log.theta_hat)
        mass = estimate[..., PARAMETERS.index("payload")]
        off = 1e3 * np.abs(mass - values(arms.theta)[:, PARAMETERS.index("payload")])
        found["payload_mass_error_end_mean_g"] = float(off[-1].mean())
        found["payload_mass_error_end_max_g"] = float(off[-1].max())
        found["payload_mass_error_at_1s_mean_g"] = float(off[np.searchsorted(time, 1.0 - 1e-9)].mean())
        for name in ("bending_rigidity", "axial_rigidity", "tendon_damping"):
            ends = estimate[-1, :, PARAMETERS.index(name)]
            found[f"{name}_end"] = [float(ends[rows].mean()) for rows in _by_payload(arms.theta)]
        found["curves"]["payload_kg"] = curves(mass)
    return found


def _by_payload(theta: Tensor) -> list[Array]:
    """The rows of each payload."""
    mass = values(theta)[:, PARAMETERS.index("payload")]
    return [np.flatnonzero(mass == payload) for payload in np.unique(mass)]


def _finite(value: Any) -> float | None:
    return float(value) if np.isfinite(value) else None


def run(condition: str, controller: str) -> dict[str, Any]:
    """The numbers of one controller in one condition."""
    overrides = (*CONTROLLERS[controller], *CONDITIONS[condition][0])
    if controller != "known":
        return numbers(measured(overrides))
    # A row's parameters are those of its run: one run for each payload, put together again.
    parts = [measured((*overrides, f"experiment.payloads=[{m}]", f"dynamics_law.payload={m}")) for m in PAYLOADS]
    fields = [torch.cat([getattr(o.log, name) for o in parts], dim=1) for name in parts[0].log._fields[1:-1]]
    log = parts[0].log._replace(**dict(zip(parts[0].log._fields[1:-1], fields, strict=True)))
    log = log._replace(diverged_at=torch.cat([o.log.diverged_at for o in parts]))
    return numbers(Outcome(log, parts[0].arms._replace(theta=torch.cat([o.arms.theta for o in parts]))))


COLUMNS = (
    ("to 5 mm, s", "time_to_5mm_median_s", "{:.1f}"),
    ("to 2 mm, s", "time_to_2mm_median_s", "{:.1f}"),
    ("2 s, mm", "tip_error_at_2s_mm", "{:.1f}"),
    ("5 s", "tip_error_at_5s_mm", "{:.2f}"),
    ("10 s", "tip_error_at_10s_mm", "{:.2f}"),
    ("past it, mm", "overshoot_mean_mm", "{:.1f}"),
    ("shape, mm", "shape_error_mean_mm", "{:.2f}"),
    ("at end", "shape_error_end_mm", "{:.2f}"),
    ("Psi, cm", "psi_mean_cm", "{:.2f}"),
    ("mismatch, mm", "mapping_error_mean_mm", "{:.0f}"),
    ("payload off, g", "payload_mass_error_end_mean_g", "{:.0f}"),
    ("most", "payload_mass_error_end_max_g", "{:.0f}"),
    ("force rms, N", "tendon_force_rms_n", "{:.1f}"),
    ("peak", "tendon_force_max_n", "{:.0f}"),
)


def table(results: Mapping[str, Mapping[str, Mapping[str, Any]]]) -> str:
    """The numbers as a table in Markdown; three numbers are those of 0, 0.25 and 0.5 kg."""

    def shown(value: Any, form: str) -> str:
        if isinstance(value, list):
            return " / ".join("-" if part is None else form.format(part) for part in value)
        return "" if value is None else form.format(value)

    lines = []
    for condition, rows in results.items():
        lines += ["", f"**{condition}**", "", "| | " + " | ".join(head for head, _, _ in COLUMNS) + " |"]
        lines.append("|---" * (len(COLUMNS) + 1) + "|")
        for name, found in rows.items():
            cells = [shown(found.get(key), form) for _, key, form in COLUMNS]
            bad = f" ({found['diverged_rows']:.0f} diverged)" if found["diverged_rows"] else ""
            lines.append(f"| {name}{bad} | " + " | ".join(cells) + " |")
    return "\n".join(lines)


def draw(results: Mapping[str, Mapping[str, Mapping[str, Any]]], path: Path) -> None:
    """Tip error with the largest payload, the estimated payloads, and the time to 5 mm."""
    quiet = results["quiet"]
    colours = dict(zip(CONTROLLERS, SERIES, strict=True))
    figure = new_figure(15.0, 5.0)
    left, middle, right = figure.subplots(1, 3, width_ratios=(1.25, 1.0, 1.0))
    for name, found in quiet.items():
        curves = found["curves"]
        dashes = (0, (4, 3)) if name == "known" else "-"
        left.plot(curves["time"], curves["e_mm"][-1], color=colours[name], linewidth=2.2, linestyle=dashes, label=name)
    dress(left, "time (s)", "tip error (mm)", "with 0.5 kg, mean of ten set-points")
    log_scale(left, [np.asarray(found["curves"]["e_mm"][-1]) for found in quiet.values()])
    legend(left, loc="upper right")
    _draw_payloads(middle, results)
    for k, (name, found) in enumerate(quiet.items()):
        times = found["time_to_5mm_median_s"]
        heights = [10.0 if value is None else value for value in times]
        at = np.arange(len(PAYLOADS)) + 0.13 * (k - 2.5)
        bars = right.bar(at, heights, width=0.12, color=colours[name], label=name)
        for bar, value in zip(bars, times, strict=True):
            if value is None:
                bar.set_hatch("///")
                bar.set_alpha(0.35)
    right.set_xticks(range(len(PAYLOADS)), [f"{m:g} kg" for m in PAYLOADS])
    late = any(value is None for found in quiet.values() for value in found["time_to_5mm_median_s"])
    dress(right, "", "median time to 5 mm (s)", "hatched: not within 10 s" if late else "time to stay within 5 mm")
    save_figure(figure, path)


def _draw_payloads(ax: Axes, results: Mapping[str, Mapping[str, Mapping[str, Any]]]) -> None:
    looks = {
        "quiet": ("-", "composite"),
        "noise": ((0, (1, 1)), "with noise"),
        "1 m per rad": ((0, (5, 2)), "1 m per rad"),
    }
    for condition, (dashes, label) in looks.items():
        if "composite" not in results.get(condition, {}):
            continue
        curves = results[condition]["composite"]["curves"]
        for k, mass in enumerate(curves["payload_kg"]):
            ax.plot(curves["time"], mass, color=SERIES[k], linestyle=dashes, linewidth=2.0, label=None if k else label)
    for k, mass in enumerate(PAYLOADS):
        ax.axhline(mass, color=SERIES[k], linewidth=0.8)
    dress(ax, "time (s)", "estimated payload (kg)", "what it finds at the tip; thin: the truth")
    legend(ax, loc="center right", bbox_to_anchor=(1.0, 0.25))


def main() -> None:
    """Runs the comparison, or shows it again from its numbers."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", default="adaptive_dynamics.json", help="where the numbers go (default: %(default)s)")
    parser.add_argument(
        "--figure", default="docs/images/adaptive_dynamics.png", help="the figure (default: %(default)s)"
    )
    parser.add_argument("--only", nargs="*", choices=tuple(CONDITIONS), help="some of the conditions, by name")
    parser.add_argument("--draw", action="store_true", help="run nothing: table and figure from the file of --out")
    options = parser.parse_args()
    out = Path(options.out)
    results: dict[str, dict[str, Any]] = {}
    if options.draw or options.only:
        results = json.loads(out.read_text(encoding="utf-8")) if out.is_file() else {}
    if not options.draw:
        torch.set_num_threads(1)
        wanted = options.only or tuple(CONDITIONS)
        cases = [(condition, name) for condition in wanted for name in CONDITIONS[condition][1]]
        for condition, name in (bar := tqdm(cases, desc="cases")):
            bar.set_postfix_str(f"{condition}: {name}")
            results.setdefault(condition, {})[name] = run(condition, name)
            write_json(out, results)
    print(table(results))
    if "quiet" in results:
        draw(results, Path(options.figure))


if __name__ == "__main__":
    main()
