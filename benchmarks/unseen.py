"""Each comparison on set-points that no setting was chosen on: `python benchmarks/unseen.py`, a few minutes.

The rule of `setpoints.py` with two other seeds gives eighteen further set-points an arm; the standard and the adaptive
controller of each pair go to all of them with every payload. `--noise` is motion capture's, 0.2 mm and half a degree at
50 Hz, with a seed that no setting was chosen on either.
"""

from __future__ import annotations

import argparse

import torch
from run_settings import run_settings
from setpoints import ARMS, setpoints
from tqdm import tqdm

from apcc_torch.experiments.dynamic import curves, dynamic_metrics, simulate, thinned

PAIRS = {
    "A, run I": ("arm_1", "dynamic_run_1", "dynamic_run_1_curve"),
    "A, run II": ("arm_1", "dynamic_run_2", "dynamic_run_2_bank"),
    "A, arm 2": ("arm_2", "robot_2", "robot_2_bank"),
    "B, run II": ("arm_1", "dynamic_run_2_tuned", "dynamic_run_2_adaptive"),
    "B, arm 2": ("arm_2", "robot_2_tuned", "robot_2_adaptive"),
}
"""Comparison -> its arm, the standard and the adaptive controller's experiment."""
MOCAP = ("controller.rate=50", "plant.substeps=4", "sensors=mocap", "seed=4")
NOISY = {"A, run II": ("dynamic_run_2", "dynamic_run_2_bank_noisy", ("pose_filter=predictive",))}
"""Comparisons that have an experiment of their own for noise, and what both sides take then."""
SEEDS = (1, 2)
KEPT = {
    "shape_error_mean_mm": "shape error, mm",
    "shape_error_max_mm": "largest, mm",
    "psi_mean_cm": "Psi, cm",
    "end_effector_error_end_mm": "tip after 10 s, mm",
    "diverged_rows": "diverged",
}


def unseen(arm: str) -> str:
    """The override of the set-points; the named one, which every seed has, is left out."""
    points = torch.cat([setpoints(*ARMS[arm], seed=seed)[1:] for seed in SEEDS])
    rows = ("[" + ",".join(f"{v:.4g}" for v in point) + "]" for point in points.tolist())
    return f"experiment.setpoints=[{','.join(rows)}]"


def main() -> None:
    """Prints the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--noise", action="store_true", help="with motion capture's noise at 50 Hz")
    parser.add_argument("--compile", default="aot", help="off where there is no g++ (default: %(default)s)")
    options = parser.parse_args()
    torch.set_num_threads(1)
    lines = [f"{'':<12}" + "".join(f"{title:>26}" for title in KEPT.values())]
    for name, (arm, standard, adaptive) in tqdm(PAIRS.items(), desc="comparisons"):
        common = [unseen(arm), f"compile={options.compile}"]
        if options.noise:
            standard, adaptive, filtered = NOISY.get(name, (standard, adaptive, ()))
            common += [*MOCAP, *filtered]
        sides = []
        for experiment, adapts in ((standard, "false"), (adaptive, "true")):
            config = run_settings(f"experiment={experiment}", f"controller.adaptive={adapts}", *common)
            run = simulate(config)
            sides.append(dynamic_metrics(curves(thinned(run.log), run.arms), run.log.diverged_at))
        line = f"{name:<12}"
        for key in KEPT:
            old, new = (side[key] for side in sides)
            change = f" ({100.0 * (new / old - 1.0):+.0f} %)" if old else ""
            line += f"{f'{old:.2f} -> {new:.2f}{change}':>26}"
        lines.append(line)
    print(*lines, sep="\n")


if __name__ == "__main__":
    main()
