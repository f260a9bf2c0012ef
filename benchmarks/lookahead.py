"""What a look ahead wins, and what it costs: `python benchmarks/lookahead.py`.

  rate         the controller's step and its look ahead, one arm 1, 256 rollouts of 0.3 s
  settle       run II of section V-B with 0.5 kg on the held-out set-points; the settings were chosen on the others
  obstacle     20 targets behind a ball, drawn with seed 0: the true arm's least distance from it
  tracking     the sine of experiment=tracking with 0.5 kg

each beside the standard controller and the law that ships, and the composite controller or the clearance cost in the
null space. It prints the tables and writes lookahead.json. For a part: --only rate settle.
"""

from __future__ import annotations

import argparse
import json
import platform
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from run_settings import run_settings
from torch import Tensor

from apcc_torch.composition.build import Builder
from apcc_torch.control.clearance import ClearanceCost
from apcc_torch.control.inverse_kinematics import elongation_cost
from apcc_torch.control.lookahead_controller import LookaheadController
from apcc_torch.control.obstacles import Sphere
from apcc_torch.control.step_io import Measurement, Target
from apcc_torch.control.task_controller import TaskController
from apcc_torch.control.trajectory import SetPoint
from apcc_torch.experiments.dynamic import simulate
from apcc_torch.files import write_json
from apcc_torch.model.abscissae import decouple
from apcc_torch.native import NativeFunction
from apcc_torch.report.dynamic import settling_times
from apcc_torch.report.style import values
from apcc_torch.simulation.dynamic import DynamicLog, DynamicSettings, simulate_dynamic
from apcc_torch.simulation.sensors import PoseSensors

RUN = ("compile=aot", "experiment=dynamic_run_2")
CONTROLLERS: dict[str, tuple[str, ...]] = {
    "standard": (*RUN, "controller.adaptive=false"),
    "law": RUN,
    "look ahead, law": (*RUN, "lookahead=mppi"),
    "composite": ("compile=aot", "experiment=dynamic_run_2_composite"),
    "look ahead, lengths fixed": (*RUN, "controller.adaptive=false", "lookahead=mppi"),
}
HELD_OUT = ("experiment.subset=held_out", "experiment.payloads=[0.5]", "experiment.duration=8")
CENTRE, RADIUS, ARM_RADIUS = (0.16, 0.0, -0.27), 0.07, 0.03
GOAL, SCATTER = (0.30, 0.0, -0.42), 0.05
DISTANCE = 0.01
"""To be kept from the ball, m; what both controllers are told begins 1 cm before it."""


def rate(calls: int = 300) -> dict[str, float]:
    """Milliseconds of a step and of a look, medians and the worst of a hundred, and both together as a rate."""
    build = Builder(run_settings(*CONTROLLERS["look ahead, law"]))
    controller = build.controller()
    assert isinstance(controller, LookaheadController)
    lengths, q = build.rest_lengths(), torch.zeros(controller.backbone.n, dtype=torch.float64)
    T = controller.backbone.pose(q, lengths, *decouple(build.sensors_at(), lengths))
    target = Target(torch.tensor([0.2, 0.1, -0.5], dtype=torch.float64), torch.zeros(3, dtype=torch.float64))
    zero = torch.zeros((), dtype=torch.float64)
    state = controller.initial_state(q, lengths, zero)
    run = controller.rollouts("aot")
    step = NativeFunction(controller, (state, Measurement(T, zero), target))
    took: dict[str, list[float]] = {"step": [], "look": []}
    with torch.inference_mode():
        for k in range(calls + 20):
            began = time.perf_counter()
            state, _ = step(state, Measurement(T, zero + 0.01 * (k + 1)), target)
            between = time.perf_counter()
            state = controller.look_ahead(state, target, run)
            took["step"].append(1e3 * (between - began))
            took["look"].append(1e3 * (time.perf_counter() - between))
    both = np.add(took["step"], took["look"])[20:]
    found = {f"{name}_median_ms": float(np.median(each[20:])) for name, each in took.items()}
    return found | {
        "look_least_ms": float(np.min(took["look"][20:])),
        "look_p99_ms": float(np.percentile(took["look"][20:], 99)),
        "rate_hz": 1e3 / float(np.median(both)),
        "rate_of_p99_hz": 1e3 / float(np.percentile(both, 99)),
        "rollouts": float(controller.lookahead.samples),
        "horizon_s": controller.lookahead.loop.horizon,
        "threads": float(torch.get_num_threads()),
    }


def settle(overrides: Sequence[str]) -> dict[str, float]:
    """How one controller settles on the held-out set-points."""
    log = simulate(run_settings(*overrides, *HELD_OUT)).log
    e, seconds = values((log.x_d - log.x).norm(dim=-1)), values(log.time)
    ten, five = (settling_times(seconds, e, limit) for limit in (0.01, 0.005))
    return {
        "to_10mm_median_s": float(np.median(ten)),
        "to_10mm_mean_s": float(np.mean(ten)),
        "to_10mm_max_s": float(np.max(ten)),
        "to_5mm_median_s": float(np.median(five)),
        "psi_mean_cm": 1e2 * float(elongation_cost(log.q_bar).mean()),
        "end_mean_mm": 1e3 * float(e[-1].mean()),
        "force_rms_n": float(log.u.square().mean().sqrt()),
        "force_max_n": float(log.u.abs().max()),
        "diverged_rows": float((log.diverged_at >= 0).sum()),
    }


def goals(runs: int = 20) -> Tensor:
    """(runs, 3) targets behind the ball, m."""
    chance = torch.Generator().manual_seed(0)
    scatter = SCATTER * (2.0 * torch.rand(runs, 3, generator=chance, dtype=torch.float64) - 1.0)
    return torch.tensor(GOAL, dtype=torch.float64) + scatter


def around(name: str) -> dict[str, float]:
    """20 runs around the ball under one controller, without a payload."""
    ball = Sphere(torch.tensor(CENTRE, dtype=torch.float64), RADIUS)
    told = (*RUN, "controller.adaptive=false")
    if name == "look ahead":
        told = (*told, "lookahead=mppi", f"lookahead.spheres=[{[*CENTRE, RADIUS]}]")
        told = (*told, f"lookahead.radius={ARM_RADIUS}", f"lookahead.clearance={2 * DISTANCE}")
    config = run_settings(*told)
    build = Builder(config)
    controller = build.controller()
    if name == "null space":
        near = ClearanceCost([ball], radius=ARM_RADIUS, activation=2 * DISTANCE, points=40, gain=1.0)
        controller = TaskController.on(config.arm, config, clearance=near)
    x_d = goals()
    plant = build.plant(torch.zeros(len(x_d), dtype=torch.float64))
    settings = DynamicSettings(duration=6.0, control_rate=config.controller.rate, compile="aot")
    with torch.inference_mode():
        log: DynamicLog = simulate_dynamic(
            plant, controller, PoseSensors(), SetPoint(x_d), build.first_estimate(), settings
        )
        look = ClearanceCost([ball], radius=ARM_RADIUS, points=40)
        gap = look.clearance(plant.backbone, log.q_true, plant.dynamics.lengths).obstacles.amin(0)
    e = (log.x_d - log.x)[-1].norm(dim=-1)
    return {
        "kept_runs": float((gap >= DISTANCE).sum()),
        "runs": float(len(gap)),
        "least_mm": 1e3 * float(gap.min()),
        "median_least_mm": 1e3 * float(gap.median()),
        "arrived_within_10mm": float((e < 0.01).sum()),
        "end_median_mm": 1e3 * float(e.median()),
    }


def tracked(overrides: Sequence[str]) -> dict[str, float]:
    """How one controller follows the sine from its fourth second on."""
    moved = [word.replace("dynamic_run_2_composite", "tracking") for word in overrides]
    moved = [word.replace("dynamic_run_2", "tracking") for word in moved]
    if any("composite" in word for word in overrides):
        moved += ["dynamics_law=composite", "adaptation=none"]
    log = simulate(run_settings(*moved, "experiment.payloads=[0.5]", "experiment.duration=14")).log
    e = (log.x_d - log.x).norm(dim=-1)[log.time >= 4.0]
    return {"rms_mm": 1e3 * float(e.square().mean().sqrt()), "max_mm": 1e3 * float(e.max())}


def table(results: dict[str, Any]) -> str:
    """Everything that was measured."""
    lines = []
    for part, found in results.items():
        if part == "machine":
            continue
        rows = found if all(isinstance(each, dict) for each in found.values()) else {"one arm": found}
        columns = list(next(iter(rows.values())))
        lines += [f"\n{part}", "| | " + " | ".join(columns) + " |", "|---" * (len(columns) + 1) + "|"]
        lines += [f"| {row} | " + " | ".join(f"{each[c]:.4g}" for c in columns) + " |" for row, each in rows.items()]
    return "\n".join(lines)


def main() -> None:
    """Measures, prints and saves."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parts = ("rate", "settle", "obstacle", "tracking")
    parser.add_argument("--out", default="lookahead.json", help="where the numbers go (default: %(default)s)")
    parser.add_argument("--only", nargs="*", choices=parts, default=parts, help="some of the parts")
    parser.add_argument("--threads", type=int, default=1, help="torch threads (default: %(default)s)")
    options = parser.parse_args()
    torch.set_num_threads(options.threads)
    out = Path(options.out)
    results: dict[str, Any] = json.loads(out.read_text(encoding="utf-8")) if out.is_file() else {}
    results["machine"] = {"python": platform.python_version(), "torch": torch.__version__}
    if "rate" in options.only:
        results["rate"] = rate()
        write_json(out, results)
    for part, of in {"settle": settle, "tracking": tracked}.items():
        if part in options.only:
            for name, overrides in CONTROLLERS.items():
                results.setdefault(part, {})[name] = of(overrides)
                write_json(out, results)
    if "obstacle" in options.only:
        for name in ("no look at the ball", "null space", "look ahead"):
            results.setdefault("obstacle", {})[name] = around(name)
            write_json(out, results)
    print(table(results))


if __name__ == "__main__":
    main()
