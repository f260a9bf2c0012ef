"""python -m apcc_torch.demo: a first loop on an arm, closed and drawn in a few seconds, and what to try next."""

from __future__ import annotations

import sys
import time
from collections.abc import Sequence
from functools import partial
from pathlib import Path

import torch

from apcc_torch.composition.arguments import Arguments
from apcc_torch.control.adaptation import NormalisedLawSettings
from apcc_torch.control.controller import APCCController
from apcc_torch.control.trajectory import SineTrajectory
from apcc_torch.errors import one_sentence
from apcc_torch.experiments.folder import progress_bar
from apcc_torch.model.arm import Arm
from apcc_torch.plain_text import for_terminal
from apcc_torch.report.kinematic import convergence_figure
from apcc_torch.report.style import save_figure
from apcc_torch.simulation.kinematic import KinematicLog, simulate_feedback

FOLDER, PICTURE = "runs/demo", "demo.png"
FIRST = 1.1
"""The first estimates over the true rest lengths."""
DURATION, RATE, LATE = 10.0, 50.0, 5.0
"""s, Hz, and the seconds at the end over which errors are told."""
NEXT = """\
Next, an arm of yours:
  python -m apcc_torch.new_arm mine --lengths 0.2,0.25 --offset 0.015 --mass 0.4
  python -m apcc_torch.simulate experiment=kinematic arm=mine.yaml
  python -m apcc_torch.simulate experiment=dynamic_run_2_tuned arm=mine.yaml
docs/your_arm.md goes on from there, and docs/tutorials has the same in Python.
"""


def followed(arm: Arm) -> KinematicLog:
    """The arm's loop on a target that moves: section V-A of the paper, in small."""
    controller = APCCController.for_arm(
        arm, adaptation=NormalisedLawSettings(), K=3.0, null_gain=0.75, window=5, reach="last"
    )
    centre, amplitude = torch.tensor([[0.0, 0.0, -0.375], [0.3, 0.15, 0.05]], dtype=torch.float64)  # m
    lengths = arm.rest_lengths()
    target = SineTrajectory(centre, amplitude, 0.63)
    return simulate_feedback(
        controller, lengths, FIRST * lengths, target, DURATION, RATE, progress_bar("a loop", shown=True)
    )


def told(arm: Arm, log: KinematicLog, seconds: float) -> str:
    """What came of the loop, for a person."""
    wrong = 1e3 * (log.pi_hat - arm.rest_lengths()).abs().amax(-1)  # mm
    late = log.time >= log.time[-1] - LATE
    tip = 1e3 * (log.x_d - log.x).norm(dim=-1)[late].max()
    return (
        f"A soft arm of two sections followed a moving target for {DURATION:.0f} s, computed in {seconds:.1f} s.\n"
        f"Its model began with lengths up to {wrong[0]:.0f} mm too long.\n"
        f"  lengths, last {LATE:.0f} s   within {wrong[late].max():.1f} mm\n"
        f"  tip, last {LATE:.0f} s       within {tip:.1f} mm of the target\n"
    )


def main(argv: Sequence[str] | None = None) -> None:
    """Console entry point."""
    parser = Arguments.described("demo", __doc__, NEXT)
    parser.add_argument(
        "folder", nargs="?", default=FOLDER, help=f"where {PICTURE} goes, over an earlier one (default: %(default)s)"
    )
    folder = Path(parser.parse_args(argv).folder)
    torch.set_num_threads(1)  # small tensors: threads would cost more than they bring
    arm = Arm(lengths=(0.2, 0.25), name="demo")
    began = time.perf_counter()
    log = followed(arm)
    said = told(arm, log, time.perf_counter() - began)
    sensors, draw = arm.sensor_places(), partial(convergence_figure, log, arm.rest_lengths())
    with one_sentence(lambda text: sys.stderr.write(f"apcc_torch.demo: {text}\n")):
        path = save_figure(draw(sensors, arm.backbone(), end=5.0), folder / PICTURE)
    sys.stdout.write(for_terminal(f"{said}{path} shows it.\n\n{NEXT}"))


if __name__ == "__main__":
    main()
