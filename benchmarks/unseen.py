"""Each comparison on set-points that no setting was chosen on: `python benchmarks/unseen.py`, a few minutes.

The rule of `setpoints.py` with two other seeds gives eighteen further set-points an arm; the standard and the adaptive
controller of each pair of `apcc_torch.benchmark` go to all of them with every payload. Settings are that program's:

    python benchmarks/unseen.py 'experiments.common=["compile=aot","controller.rate=50","seed=4"]'
"""

from __future__ import annotations

from dataclasses import replace

import torch
from comparisons import compare
from setpoints import setpoints

from apcc_torch.composition.run_settings import SimulateSettings
from apcc_torch.experiments.dynamic import metrics, simulate

SEEDS = (1, 2)
KEPT = {
    "shape_error_mean_mm": "shape error, mm",
    "shape_error_max_mm": "largest, mm",
    "psi_mean_cm": "Psi, cm",
    "end_effector_error_end_mm": "tip after 10 s, mm",
    "diverged_rows": "diverged",
}


def measured(config: SimulateSettings, adaptive: bool) -> dict[str, float]:
    """The metrics on the unseen set-points; the named one, which every seed has, is left out."""
    named, lengths = tuple((config.experiment.setpoints or [])[0]), tuple(config.arm.lengths)
    points = torch.cat([setpoints(lengths, named, seed=seed)[1:] for seed in SEEDS])
    experiment = replace(config.experiment, setpoints=points.tolist())
    return metrics(simulate(replace(config, experiment=experiment), adaptive))


if __name__ == "__main__":
    compare(__doc__, measured, KEPT)
