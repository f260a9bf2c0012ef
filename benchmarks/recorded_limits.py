"""What can be known beyond the last disk that is shown, on recordings: `python benchmarks/recorded_limits.py`.

No sensor tells of the last section where only disks 1 and 2 are shown. Two of these columns look at the answer, disk 3,
and are bounds: the last section's strains are the others' times constants, as they are under every law that believes
strains to go together, and scipy finds the constants that turn out best.

- *law*, *fixed*: the shipped law's estimator, and sections of constant curvature through the same sensors.
- *their ratio*: with the interval that holds 95 % of what other draws of ten stretches of the recording give.
- *continued*: the last section bent and stretched as the one before.
- *best constants*: bend and stretch of the last section by those of the others, four numbers, one set a recording.
- *the first's*: those that turn out best on the first line.
"""

from __future__ import annotations

import argparse

import numpy as np
import torch
from hydra import compose
from scipy.optimize import least_squares
from torch import Tensor

from apcc_torch import evaluate
from apcc_torch.composed import initialised
from apcc_torch.composition.data_file import data_override
from apcc_torch.composition.evaluate import EvaluateSettings, recordings
from apcc_torch.composition.identify import parameters
from apcc_torch.composition.schema import typed
from apcc_torch.evaluation.frames import Frames
from apcc_torch.evaluation.leaderboard import rms_mm
from apcc_torch.evaluation.method import Known
from apcc_torch.evaluation.sections_methods import Posterior, ThroughSensors, wide
from apcc_torch.evaluation.shape_as_built import ShapeAsBuilt
from apcc_torch.evaluation.shape_posterior import Sections
from apcc_torch.evaluation.tasks import Task

SETS = ("trunk", "trunk_payload")
STRETCHES, DRAWS = 10, 2000
NEEDED = evaluate.CHOICE
"""Importing the program is what tells Hydra of its settings."""


def scored(name: str) -> tuple[Known, dict[str, Frames]]:
    """What a method may know, and the moments of each session that are scored."""
    with initialised():
        settings = typed(compose("evaluate", data_override([f"data={name}"])), EvaluateSettings)
    sessions, rest = recordings(settings, lambda session, why: print(f"{session}: {why}"))
    blocks, fit = parameters(settings), settings.fit
    known = Known(settings.arm, blocks, blocks, rest, fit, fit.samples, settings.seed, lambda line: None)
    frames = {each.name: each.frames.at(each.folds[0].validation[:: settings.every]) for each in sessions}
    return known, {session: each.gated(known.calibration) for session, each in frames.items()}


def continued(told: Tensor, constants: Tensor) -> Tensor:
    """q (N, 9) of three sections, of which the last is (a1 b1 + a2 b2, a3 e1 + a4 e2) by two (N, 6) that are told."""
    first, second = told.unflatten(-1, (2, 3)).unbind(-2)
    a1, a2, a3, a4 = constants
    bend = a1 * first[:, :2] + a2 * second[:, :2]
    return torch.cat((told, bend, a3 * first[:, 2:] + a4 * second[:, 2:]), dim=-1)


def best(sections: Sections, told: Tensor, answer: Tensor) -> Tensor:
    """The four constants that leave least of the last body's places (N, 3)."""

    def off(constants: np.ndarray) -> np.ndarray:
        found = sections.positions(continued(told, torch.from_numpy(constants)))[:, 2]
        return np.asarray((found - answer).flatten())

    return torch.from_numpy(least_squares(off, np.array([0.0, 1.0, 0.0, 1.0])).x)


def ratio(ours: Tensor, theirs: Tensor) -> tuple[float, float, float]:
    """Of the roots of mean squares (N,), and the interval over draws of stretches."""
    draw, parts = np.random.default_rng(0), np.array_split(np.arange(len(ours)), STRETCHES)
    sums = torch.stack([torch.stack((ours[part].sum(), theirs[part].sum())) for part in parts])
    drawn = sums[torch.from_numpy(draw.integers(0, STRETCHES, (DRAWS, STRETCHES)))].sum(1)
    low, high = np.quantile((drawn[:, 0] / drawn[:, 1]).sqrt().numpy(), (0.025, 0.975))
    return float((ours.sum() / theirs.sum()).sqrt()), float(low), float(high)


def main() -> None:
    """Prints the table."""
    argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter).parse_args()
    torch.set_num_threads(1)
    print("| disk 3 from disks 1 and 2 | fixed | law | their ratio | continued | best constants | the first's |")
    print("|---|---|---|---|---|---|---|")
    first: Tensor | None = None
    for name in SETS:
        known, sessions = scored(name)
        sections = Posterior(known).at_rest()
        methods = ShapeAsBuilt(known), ThroughSensors(known)
        for session, frames in sessions.items():
            for method in methods:
                method.fit(frames)  # neither learns
            answer, turned = frames.positions[:, 2], bool(frames.rotations.isfinite().any())
            for task in (Task((0, 1), False, with_them) for with_them in {False, turned}):
                with torch.no_grad():
                    seen = frames.showing(task)
                    q = sections.most_probable(seen.positions, seen.rotations, [wide(sections.model)])
                    law, fixed = (method.predict(seen, task)[:, 2] for method in methods)
                    told, lengths = q[:, :6], sections.lengths
                    alike, none = lengths[2] / lengths[1], lengths.new_zeros(())
                    as_before = torch.stack((none, alike, none, alike))
                    constants = best(sections, told, answer)
                    first = constants if first is None else first
                    tried = [sections.positions(continued(told, c))[:, 2] for c in (as_before, constants, first)]
                share, low, high = ratio(*((each - answer).square().sum(-1) for each in (law, fixed)))
                cells = [f"{rms_mm(each, answer):.2f}" for each in (fixed, law, *tried)]
                cells.insert(2, f"{share:.2f} ({low:.2f} to {high:.2f})")
                turn = ", orientations" if task.orientations else ""
                print(f"| {name}, {session}{turn} | " + " | ".join(cells) + " |", flush=True)


if __name__ == "__main__":
    main()
