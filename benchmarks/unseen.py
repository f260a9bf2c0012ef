"""Each comparison on set-points that no setting was chosen on: `python benchmarks/unseen.py`, a few minutes.

The rule of `setpoints.py` with two other seeds gives eighteen further set-points an arm; the standard and the adaptive
controller of each pair of `apcc_torch.benchmark` go to all of them with every payload. Settings are that program's:

    python benchmarks/unseen.py grid.comparisons.B.runs.robot_2.adaptive=robot_2_tuned_bank
    python benchmarks/unseen.py 'experiments.common=["compile=aot","controller.rate=50","seed=4"]'
"""

from __future__ import annotations

import argparse
from dataclasses import replace

import torch
from hydra import compose, initialize_config_dir
from setpoints import setpoints
from tqdm import tqdm

from apcc_torch.benchmark import compose_pairs
from apcc_torch.conf_path import conf_path
from apcc_torch.configs.benchmark import BenchmarkConfig
from apcc_torch.configs.schema import SimulateConfig
from apcc_torch.configs.typed import typed
from apcc_torch.experiments.dynamic import metrics, simulate

SEEDS = (1, 2)
COMPILED = 'experiments.common=["compile=aot"]'
KEPT = {
    "shape_error_mean_mm": "shape error, mm",
    "shape_error_max_mm": "largest, mm",
    "psi_mean_cm": "Psi, cm",
    "end_effector_error_end_mm": "tip after 10 s, mm",
    "diverged_rows": "diverged",
}


def measured(config: SimulateConfig, adaptive: bool) -> dict[str, float]:
    """The metrics on the unseen set-points; the named one, which every seed has, is left out."""
    named, lengths = tuple((config.experiment.setpoints or [])[0]), tuple(config.robot.rest_lengths)
    points = torch.cat([setpoints(lengths, named, seed=seed)[1:] for seed in SEEDS])
    experiment = replace(config.experiment, setpoints=points.tolist())
    return metrics(simulate(replace(config, experiment=experiment), adaptive))


def main() -> None:
    """Prints the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("settings", nargs="*", help="of apcc_torch.benchmark; at first " + COMPILED)
    settings = parser.parse_args().settings
    torch.set_num_threads(1)
    with initialize_config_dir(conf_path(), version_base="1.3"):
        pairs = compose_pairs(typed(compose("benchmark", [COMPILED, *settings]), BenchmarkConfig))
    runs = {f"{name}, {run}": both for name, comparison in pairs.items() for run, both in comparison.items()}
    lines = [f"{'':<12}" + "".join(f"{title:>26}" for title in KEPT.values())]
    for name, both in tqdm(runs.items(), desc="comparisons"):
        standard, adaptive = measured(both.standard, False), measured(both.adaptive, True)
        line = f"{name:<12}"
        for key in KEPT:
            old, new = standard[key], adaptive[key]
            change = f" ({100.0 * (new / old - 1.0):+.0f} %)" if old else ""
            line += f"{f'{old:.2f} -> {new:.2f}{change}':>26}"
        lines.append(line)
    print(*lines, sep="\n")


if __name__ == "__main__":
    main()
