"""Each comparison for as long as an arm may have to stand: `python benchmarks/hold.py`, a few minutes.

The runs of `apcc_torch.benchmark` go on for three minutes instead of ten seconds; what winds up in a controller, or
drifts in an adapting model, shows itself after that. Settings are that program's:

    python benchmarks/hold.py 'experiments.adaptive=["controller.null_speed=null"]'
"""

from __future__ import annotations

from dataclasses import replace

import torch
from comparisons import compare

from apcc_torch.configs.schema import SimulateConfig
from apcc_torch.experiments.dynamic import curves, simulate, thinned

DURATION = 180.0
TIMES = (10.0, 60.0, 180.0)
TITLES = {f"tip_{time:.0f}": f"tip after {time:.0f} s, mm" for time in TIMES} | {
    "tip_worst": "the farthest, mm",
    "shape": "shape error then, mm",
    "diverged": "diverged",
}


def measured(config: SimulateConfig, adaptive: bool) -> dict[str, float]:
    """Tip errors at the times, and at the last one the farthest tip, the shape error, and rows that diverged."""
    outcome = simulate(replace(config, experiment=replace(config.experiment, duration=DURATION)), adaptive)
    c = curves(thinned(outcome.log), outcome.arms)
    at = [int((c.time - time).abs().argmin()) for time in TIMES]
    found = {f"tip_{time:.0f}": 1e3 * float(c.e[i].mean()) for time, i in zip(TIMES, at, strict=True)}
    found |= {"tip_worst": 1e3 * float(c.e[-1].max()), "shape": 1e3 * float(c.shape_error[-1].mean())}
    return found | {"diverged": float(torch.count_nonzero(outcome.log.diverged_at >= 0))}


if __name__ == "__main__":
    compare(__doc__, measured, TITLES)
