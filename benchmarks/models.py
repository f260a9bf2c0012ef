"""Kinematic models compared: `python benchmarks/models.py` writes models.json and the table of docs/models.md.

Section V-B's arm under 0.5 kg, poses seen, ten set-points, 6 s: every model with two, three and four sections of fixed
rest lengths. Beside what they reach, what one arm's step costs: eager, and with --compiled as machine code, which takes
minutes to build for the larger models.
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path

import torch
from page import between
from run_settings import GENTLE, run_settings
from sections import SECTIONS, with_sections
from timing import timed_steps
from tqdm import tqdm

from apcc_torch.composition.build import Builder
from apcc_torch.composition.run_settings import SimulateSettings
from apcc_torch.control.controller import APCCController
from apcc_torch.control.step_io import Measurement, Target
from apcc_torch.experiments.dynamic import curves, simulate, thinned
from apcc_torch.experiments.dynamic_metrics import dynamic_metrics
from apcc_torch.files import write_atomically, write_json
from apcc_torch.native.function import NativeFunction

MODELS: dict[str, tuple[str, ...]] = {
    "constant curvature": ("model=pcc",),
    "+ torsion": ("model=constant_strain",),
    "+ torsion, shear": (
        "model=constant_strain",
        "model.strains=[bend_x,bend_y,torsion,shear_x,shear_y,elongation]",
    ),
    "affine curvature": ("model=affine",),
}  # fmt: skip
POSES = (
    "experiment=dynamic_run_2_tuned", "experiment.payloads=[0.5]", "experiment.duration=6.0",
    "controller.adaptive=false", *GENTLE,
)  # fmt: skip
KEPT = (
    "shape_error_mean_mm", "shape_error_max_mm", "sensor_error_linear_mean_mm", "sensor_error_angular_mean_rad",
    "psi_mean_cm", "end_effector_error_end_mm", "diverged_rows",
)  # fmt: skip
LOST = 600.0  # mm, the arm's length: beyond it the estimate has run away
START, END = "<!-- table: python benchmarks/models.py -->", "<!-- end of table -->"


def settings(model: str, sections: int) -> SimulateSettings:
    """One setting's configuration."""
    return run_settings(*POSES, *MODELS[model], *with_sections(SECTIONS[sections]))


def _step_times(controller: APCCController, lengths: torch.Tensor, compiled: bool) -> dict[str, float]:
    """Time of one arm's step in us, eager and compiled: what a tenth of the calls stay below, for a busy machine shows
    least in it."""
    like = torch.zeros((), dtype=lengths.dtype)
    state = controller.initial_state(like.expand(controller.backbone.n).clone(), lengths, like)
    T = torch.eye(4, dtype=like.dtype).expand(controller.feedback.abscissae.shape[-1], 4, 4).clone()
    T[:, :3, :3] = controller.backbone.base_rotation
    T[:, 2, 3] = -controller.feedback.abscissae
    T[:, 0, 3] = controller.feedback.abscissae**2 * 0.5
    target = Target(torch.tensor([0.2, 0.0, -0.5]).to(like), torch.zeros(3).to(like))
    arguments = (state, Measurement(T, like + 0.01), target)
    found = {"eager_us": timed_steps(controller, [arguments], 150)["p10_us"]}
    if compiled:
        found["compiled_us"] = timed_steps(NativeFunction(controller, arguments), [arguments], 2000)["p10_us"]
    return found


def measured(model: str, sections: int, compiled: bool = False) -> dict[str, float]:
    """What one setting reaches and costs."""
    config = settings(model, sections)
    outcome = simulate(config)
    metrics = dynamic_metrics(curves(thinned(outcome.log, 100), outcome.arms))
    build = Builder(config)
    with torch.inference_mode():
        costs = _step_times(build.controller(), build.rest_lengths(), compiled)
    return {name: metrics[name] for name in KEPT} | {"coordinates": float(build.backbone().n)} | costs


def table(results: dict[str, dict[str, dict[str, float]]]) -> str:
    """The results as a Markdown table."""
    lines = [
        "| model | sections | n | shape error (mm) | largest (mm) | sensor error (mm) | (mrad) "
        "| Psi (cm) | end effector (mm) | step, eager (us) | compiled (us) |",
        "|---|---|---|---|---|---|---|---|---|---|---|",
    ]
    for model, by_sections in results.items():
        for sections, r in by_sections.items():
            reached = [
                f"{r['shape_error_mean_mm']:.2f}", f"{r['shape_error_max_mm']:.1f}",
                f"{r['sensor_error_linear_mean_mm']:.2f}", f"{1e3 * r['sensor_error_angular_mean_rad']:.0f}",
                f"{r['psi_mean_cm']:.1f}", f"{r['end_effector_error_end_mm']:.0f}",
            ]  # fmt: skip
            if r["diverged_rows"] or r["shape_error_mean_mm"] > LOST:
                reached = ["lost"] + ["-"] * (len(reached) - 1)
            compiled = f"{r['compiled_us']:.0f}" if "compiled_us" in r else ""
            cells = [model, sections, f"{r['coordinates']:.0f}", *reached, f"{r['eager_us']:.0f}", compiled]
            lines.append("| " + " | ".join(cells) + " |")
    return "\n".join(lines)


def main() -> None:
    """Runs all settings, or writes the table again from their numbers."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", default="models.json", help="where the numbers go (default: %(default)s)")
    parser.add_argument("--page", default="docs/models.md", help="the page that holds the table (default: %(default)s)")
    parser.add_argument("--compiled", action="store_true", help="time compiled steps too")
    parser.add_argument("--table", action="store_true", help="only write the table, from the file of --out")
    options = parser.parse_args()
    torch.set_num_threads(1)
    results: dict[str, dict[str, dict[str, float]]] = {}
    if options.table:
        results = json.loads(Path(options.out).read_text(encoding="utf-8"))
    else:
        tasks = [(model, sections) for model in MODELS for sections in SECTIONS]
        for model, sections in tqdm(tasks, desc="settings"):
            results.setdefault(model, {})[str(sections)] = measured(model, sections, options.compiled)
            write_json(options.out, results)
    page = Path(options.page)
    write_atomically(page, between(page.read_text(encoding="utf-8"), START, END, table(results)))


if __name__ == "__main__":
    main()
