"""Shape against elongation in the closed loop: `python benchmarks/trade_off.py` draws docs/images/trade_off_closed.png.

Section V-B's run II and Appendix A, all thirty runs of 10 s each, for one null-space gain after another: the gain says
how hard the arm is kept from stretching, and every controller may have it. The fixed model, the gradient law, the bank
of models, and the bank whose total length follows, each with the estimator that suits it; all gains of one controller
are rows of one batch. A few minutes.
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path

import torch
from run_settings import BANK, run_settings
from tqdm import tqdm

from apcc_torch.composition.stacking import stacked
from apcc_torch.experiments.dynamic import curves, dynamic_metrics, one_of, simulate, thinned
from apcc_torch.files import write_json
from apcc_torch.report.style import BLUE, GREEN, ORANGE, VERMILION, dress, from_zero, legend, new_figure, save_figure

GAINS = (0.5, 1.0, 2.0, 4.0, 8.0)
ARMS = {"arm 1": "dynamic_run_2", "arm 2": "robot_2"}
UNBOUND = ("bounds.lower=null", "bounds.upper=null")
CONTROLLERS = {
    "fixed": (("controller.adaptive=false",), VERMILION),
    "curve": (
        ("residual.time_constant=0.3", "residual.elongation_weight=0.05", "residual.nominal_weight=0.02"),
        ORANGE,
    ),
    "bank": ((*BANK, *UNBOUND, "residual.stretch=0.0"), GREEN),
    "bank, total follows": ((*BANK, *UNBOUND, "residual.stretch=1.0", "controller.elongation_bound=0.2"), BLUE),
}  # fmt: skip
"""Controller -> its settings and its colour."""
KEPT = ("shape_error_mean_mm", "shape_error_max_mm", "psi_mean_cm", "end_effector_error_end_mm", "diverged_rows")

Results = dict[str, dict[str, dict[str, dict[str, float]]]]


def measured(overrides: tuple[str, ...], compile: str) -> dict[str, dict[str, float]]:
    """{null-space gain: metrics} of one controller."""
    configs = [run_settings(*overrides, f"controller.null_gain={gain}", f"compile={compile}") for gain in GAINS]
    every = simulate(stacked(configs), points=len(configs))
    found = {}
    for p, (gain, config) in enumerate(zip(GAINS, configs, strict=True)):
        outcome = one_of(every, config, p)
        metrics = dynamic_metrics(curves(thinned(outcome.log, 100), outcome.arms))
        found[f"{gain:g}"] = {name: metrics[name] for name in KEPT}
    return found


def draw(results: Results, path: Path) -> None:
    """Mean shape error and tip error over mean Psi, a line a controller."""
    figure = new_figure(10.0, 4.2 * len(results))
    panels = figure.subplots(len(results), 2, squeeze=False)
    for axes, (arm, controllers) in zip(panels, results.items(), strict=True):
        for controller, by_gain in controllers.items():
            colour = CONTROLLERS[controller][1]
            psi = [r["psi_mean_cm"] for r in by_gain.values()]
            for ax, name in zip(axes, ("shape_error_mean_mm", "end_effector_error_end_mm"), strict=True):
                y = [r[name] for r in by_gain.values()]
                ax.plot(psi, y, "o-", color=colour, label=controller, linewidth=2.0, markersize=4)
        for ax, label in zip(axes, ("mean shape error (mm)", "tip error after 10 s (mm)"), strict=True):
            dress(ax, r"mean $\Psi$ (cm)", label, arm)
            from_zero(ax)
        legend(axes[0], loc="lower right")
    save_figure(figure, path)


def main() -> None:
    """Runs all, or draws again from the numbers."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", default="trade_off.json", help="where the numbers go (default: %(default)s)")
    parser.add_argument("--figure", default="docs/images/trade_off_closed.png", help="default: %(default)s")
    parser.add_argument("--compile", default="aot", help="off where there is no g++ (default: %(default)s)")
    parser.add_argument("--draw", action="store_true", help="only draw, from the file of --out")
    options = parser.parse_args()
    torch.set_num_threads(1)
    results: Results = {}
    if options.draw:
        results = json.loads(Path(options.out).read_text(encoding="utf-8"))
    else:
        tasks = [(arm, controller) for arm in ARMS for controller in CONTROLLERS]
        for arm, controller in tqdm(tasks, desc="controllers"):
            found = measured((f"experiment={ARMS[arm]}_tuned", *CONTROLLERS[controller][0]), options.compile)
            results.setdefault(arm, {})[controller] = found
            write_json(options.out, results)
    print(f"{'arm':<8}{'controller':<22}{'null gain':>10}" + "".join(f"{name:>28}" for name in KEPT))
    for arm, controllers in results.items():
        for controller, by_gain in controllers.items():
            for gain, r in by_gain.items():
                print(f"{arm:<8}{controller:<22}{gain:>10}" + "".join(f"{r[name]:>28.3f}" for name in KEPT))
    draw(results, Path(options.figure))


if __name__ == "__main__":
    main()
