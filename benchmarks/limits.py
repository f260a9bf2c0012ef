"""What the shipped law leaves, beside what sections of constant curvature can do at all: `python benchmarks/limits.py`.

The truth is known here, as no controller knows it. At instants of each run, three of

- the law, and the fixed model on its own run;
- the law's fit with the true shape in place of the estimated one: what is left to the estimator lies between the two;
- the least mean distance, Eq. (52), that any bends and lengths of the model's sections have from the true shape, by
  scipy's least squares on reweighted distances, from the law's own fit and from evenly bent sections.

    python benchmarks/limits.py                        arm 2 of comparison B, a load that a softer arm picks up
    python benchmarks/limits.py B/run_2 V/nominal      others: COMPARISON/RUN of grid=paper, V/RUN of grid=variations
"""

from __future__ import annotations

import argparse
from dataclasses import replace
from typing import NamedTuple

import numpy as np
import torch
from hydra import compose
from scipy.optimize import least_squares
from torch import Tensor
from tqdm import tqdm

from apcc_torch.benchmark import compose_grids
from apcc_torch.composed import initialised
from apcc_torch.composition.benchmark import BenchmarkSettings
from apcc_torch.composition.run_settings import SimulateSettings
from apcc_torch.composition.schema import typed
from apcc_torch.control.shape_law import ShapeLawSettings
from apcc_torch.estimation.arc_fit import ArcFit
from apcc_torch.experiments.dynamic import Arms, simulate
from apcc_torch.simulation.dynamic import DynamicLog
from apcc_torch.simulation.metrics import backbone_error
from apcc_torch.simulation.progress import quiet

RUNS = ("B/robot_2", "V/picked_up_softer")
INSTANTS = 4
"""Of each row."""
POINTS = 41
"""Of a backbone."""
ROUNDS = 4
"""Of reweighting."""
STEP = 1e-6
"""Of a difference, rad and m."""
LAST = 5.0
"""s of a run of the variations that count; of the paper's all of it does."""


class Left(NamedTuple):
    """Mean shape errors, m: the fixed model's, the law's, its fit's to the true shape, and the least on either run."""

    fixed: float
    law: float
    fit: float
    least: float
    least_fixed: float


def left(config: SimulateSettings, since: float) -> Left:
    """What a run leaves from a time on, s."""
    found: list[tuple[float, float]] = []
    fit = 0.0
    for adaptive in (False, True):
        log, arms = simulate(config, adaptive, progress=quiet)
        q_true, q, pi = taken(log, since)
        points = curve(arms, q_true)
        error = backbone_error(arms.true, q_true, arms.true_lengths, arms.model, q, pi)
        best = [least(arms, *row) for row in tqdm(list(zip(points, q, pi, strict=True)), leave=False)]
        found.append((float(error.mean()), float(np.mean(best))))
        if adaptive:
            followed = fitted(config, arms, points, q, pi)
            fit = float(backbone_error(arms.true, q_true, arms.true_lengths, arms.model, followed, pi).mean())
    (fixed, least_fixed), (law, least_law) = found
    return Left(fixed, law, fit, least_law, least_fixed)


def taken(log: DynamicLog, since: float) -> tuple[Tensor, Tensor, Tensor]:
    """q_true, q_bar and pi_hat (rows, ...) of instants from a time on."""
    at = torch.linspace(0, 1, INSTANTS + 1)[1:] * (float(log.time[-1]) - since) + since
    index = (log.time.unsqueeze(-1) - at).abs().argmin(0)
    q_true, q, pi = (each[index].flatten(0, 1) for each in (log.q_true, log.q_bar, log.pi_hat))
    return q_true, q, pi


def curve(arms: Arms, q_true: Tensor) -> Tensor:
    """Points (rows, N, 3) evenly along the true arms."""
    return arms.true.points(q_true, arms.true_lengths, POINTS)


def fitted(config: SimulateSettings, arms: Arms, points: Tensor, q: Tensor, pi: Tensor) -> Tensor:
    """The law's own fit (rows, n), at rest, to the true shape."""
    law = config.adaptation if isinstance(config.adaptation, ShapeLawSettings) else ShapeLawSettings()
    fit = ArcFit(arms.model, config.arm.rest_lengths(), curve_noise=law.curve_noise, length_prior=law.length_prior)
    share = torch.linspace(0, 1, POINTS, dtype=q.dtype)[1:].expand(len(q), -1)
    for _ in range(60):
        q = fit(q, pi, points[:, 1:], share)
    return q


def least(arms: Arms, points: Tensor, q: Tensor, pi: Tensor) -> float:
    """The least mean distance of any bends and lengths from points (N, 3), m."""
    model, target = arms.model, points.numpy()
    places = model.coordinates.elongations
    lengths = pi + q[places]

    def placed(z: np.ndarray) -> np.ndarray:
        # One number of a section says how long it is: its elongation, of the law's rest lengths.
        return np.asarray(model.points(torch.from_numpy(z), lengths, POINTS))

    def distances(z: np.ndarray) -> np.ndarray:
        return np.asarray(np.linalg.norm(target - placed(z), axis=-1))

    def slopes(z: np.ndarray) -> np.ndarray:
        # Central differences, all at once.
        steps = STEP * np.eye(model.n)
        ahead, behind = placed(np.concatenate((z + steps, z - steps))).reshape(2, model.n, -1)
        return np.asarray((behind - ahead).T / (2.0 * STEP))

    start = q.clone()
    start[places] = 0.0
    best = np.inf
    for z in (start.numpy(), np.zeros(model.n)):
        for _ in range(ROUNDS):
            off = distances(z)
            weight = np.repeat(1.0 / np.sqrt(np.maximum(off, 0.05 * off.mean() + 1e-9)), 3)
            z = least_squares(
                lambda z, w=weight: w * (target - placed(z)).ravel(),
                z,
                jac=lambda z, w=weight: w[:, None] * slopes(z),
                method="lm",
                max_nfev=100,
            ).x
            best = min(best, float(distances(z).mean()))
    return best


def configured(run: str) -> tuple[SimulateSettings, float]:
    """The settings of COMPARISON/RUN, and from when on it counts, s."""
    comparison, _, name = run.partition("/")
    grid = "variations" if comparison == "V" else "paper"
    with initialised():
        config = typed(compose("benchmark", [f"grid={grid}", 'experiments.common=["compile=auto"]']), BenchmarkSettings)
    grids = compose_grids(config)
    if name not in grids.get(comparison, {}):
        known = ", ".join(f"{c}/{r}" for c, runs in grids.items() for r in runs)
        raise SystemExit(f"there is no run {run}, but {known}")
    settings = grids[comparison][name]["adaptive"].config
    settings = replace(settings, controller=settings.controller.changed(adaptive=True))
    return settings, settings.experiment.duration - LAST if comparison == "V" else 0.0


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("runs", nargs="*", default=RUNS, help="COMPARISON/RUN")
    torch.set_num_threads(1)
    print("| run, mean shape error in mm | fixed | law | its fit, the true shape known | least | of the gap closed |")
    print("|---|---|---|---|---|---|")
    for each in parser.parse_args().runs:
        of = left(*configured(each))
        closed = (of.fixed - of.law) / (of.fixed - of.least_fixed)
        print(f"| {each} | " + " | ".join(f"{1e3 * x:.3f}" for x in of[:4]) + f" | {100 * closed:.0f} % |", flush=True)
