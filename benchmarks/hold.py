"""Each comparison for as long as an arm may have to stand: `python benchmarks/hold.py`, a few minutes.

The runs of `apcc_torch.benchmark` go on for three minutes instead of ten seconds; what winds up in a controller, or
drifts in an adapting model, shows itself after that. Settings are that program's:

    python benchmarks/hold.py 'experiments.adaptive=["controller.null_speed=null"]'
"""

from __future__ import annotations

from dataclasses import replace

from comparisons import compare

from apcc_torch.composition.run_settings import SimulateSettings
from apcc_torch.experiments.dynamic import curves, simulate, thinned
from apcc_torch.experiments.dynamic_metrics import dynamic_metrics

DURATION = 180.0
TIMES = (10.0, 60.0)
TITLES = {f"tip_{time:.0f}": f"tip after {time:.0f} s, mm" for time in TIMES} | {
    "end_effector_error_end_mm": f"tip after {DURATION:.0f} s, mm",
    "end_effector_error_end_max_mm": "the farthest, mm",
    "shape_error_end_mm": "shape error then, mm",
    "diverged_rows": "diverged",
}


def measured(config: SimulateSettings, adaptive: bool) -> dict[str, float]:
    """Tip errors at the times, and the metrics of the whole run."""
    outcome = simulate(replace(config, experiment=replace(config.experiment, duration=DURATION)), adaptive)
    c = curves(thinned(outcome.log), outcome.arms)
    tips = {f"tip_{time:.0f}": 1e3 * float(c.e[(c.time - time).abs().argmin()].mean()) for time in TIMES}
    return tips | dynamic_metrics(c)


if __name__ == "__main__":
    compare(__doc__, measured, TITLES)
