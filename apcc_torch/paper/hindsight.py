"""The best constant of an experiment in hindsight: many candidates as rows of one closed loop, judged by the true arm.

A law of the rest lengths must be compared with what a constant reaches that somebody who knows the true shape picked.
Candidates run side by side in one batch; each round draws the next ones around the best so far (the cross-entropy
method), so no gradient is needed and a candidate whose run goes astray costs nothing but itself.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from math import exp, log
from typing import NamedTuple

import torch
from torch import Tensor
from torch.quasirandom import SobolEngine

from apcc_torch.composition.build import Builder
from apcc_torch.composition.run_settings import SimulateSettings
from apcc_torch.composition.stacking import stacked
from apcc_torch.errors import ConfigError
from apcc_torch.experiments.dynamic import Outcome, one_of, simulate, thinned
from apcc_torch.simulation.metrics import backbone_error
from apcc_torch.simulation.progress import quiet

ROUNDS = 5
CANDIDATES = 40
"""Of a round."""
ELITE = 6
"""Candidates whose spread the next round's is."""
LEAST = 0.01
"""Spread of a round in every direction, at least."""
ROWS = 600
"""Rows that run side by side; more would not be faster, and their logs fill the memory."""
INSTANTS, POINTS = 40, 60
"""Of a run, and of the backbone, at which the shape is compared."""
REACH = (0.2, 2.0)
"""Of the constant lengths over the nominal ones, at most."""
TOTAL = (0.75, 1.25)
"""Of their sum over the nominal one: a model that is longer or shorter by more is no model of the arm."""
GAMMAS = (1e-3, 1e3)
"""Of Eq. (15)."""

Score = Callable[[Tensor], Tensor]
"""Candidates (P, d) in the unit cube -> their scores (P,), the less the better."""


class Found(NamedTuple):
    """The best candidate.

    name: Of the setting. value: What it is best set to. score: mm, see `score`. tried: How many were run.
    """

    name: str
    value: tuple[float, ...]
    score: float
    tried: int

    def told(self) -> str:
        """In words."""
        value = ", ".join(f"{each:.4g}" for each in self.value)
        return f"{self.name} = {value}, the best of {self.tried} on the training set-points ({self.score:.3g} mm)"


def best_of(
    score: Score, size: int, first: Tensor, rounds: int, candidates: int, seed: int = 0
) -> tuple[Tensor, float]:
    """The best point (d,) found in the unit cube, and its score.

    Args:
        score: What is made least; a point whose score is not finite is never drawn around.
        size: Dimensions d.
        first: (m, d) points of the first round; the others of it are spread evenly.
        rounds, candidates: How many rounds, of how many points.
        seed: Of the draws.
    """
    generator = torch.Generator().manual_seed(seed)
    points = SobolEngine(size, scramble=True, seed=seed).draw(candidates - len(first), dtype=torch.float64)
    points = torch.cat((first, points))
    every, scores = points, score(points)
    for _ in range(rounds - 1):
        order = scores.nan_to_num(nan=torch.inf).argsort(stable=True)[:ELITE]
        elite = every[order]
        # Spread as they are, along a valley and not across it, and around the best one: the mean of several may lie
        # between two valleys, on neither's ground.
        spread = (elite - elite.mean(0)) / max(len(elite) - 1, 1) ** 0.5
        along, aside = (
            torch.randn(candidates, n, generator=generator, dtype=torch.float64) for n in (len(elite), size)
        )
        points = (elite[0] + along @ spread + LEAST * aside).clamp(0.0, 1.0)
        every, scores = torch.cat((every, points)), torch.cat((scores, score(points)))
    at = int(scores.nan_to_num(nan=torch.inf).argmin())
    return every[at], float(scores[at])


def training(config: SimulateSettings) -> SimulateSettings:
    """The experiment on the set-points that may be tuned on; all of them where there is one alone."""
    few = len(config.experiment.setpoints or ()) < 2
    return config if few else config.changed(experiment=config.experiment.changed(subset="training"))


def score(outcome: Outcome) -> float:
    """Mean shape error plus mean tip error at the end, mm: a shape may not cost the tip. Infinite after a crash."""
    few, arms = thinned(outcome.log, INSTANTS), outcome.arms
    if bool((few.diverged_at >= 0).any()):
        return float("inf")
    with torch.inference_mode():
        shape = backbone_error(arms.true, few.q_true, arms.true_lengths, arms.model, few.q_bar, few.pi_hat, POINTS)
        tip = (few.x_d[-1] - few.x[-1]).norm(dim=-1)
        total = 1e3 * float(shape.mean() + tip.mean())
    return total if total == total else float("inf")


def scores(configs: Sequence[SimulateSettings]) -> Tensor:
    """`score` (P,) of experiments that differ in numbers alone, run side by side."""
    e = configs[0].experiment
    rows = max(1, Builder(configs[0]).grid()[1].numel()) if e.setpoints else max(1, len(e.payloads))
    beside = max(1, ROWS // rows)
    found: list[float] = []
    for start in range(0, len(configs), beside):
        some = list(configs[start : start + beside])
        together = simulate(stacked(some), points=len(some), progress=quiet)
        found += [score(one_of(together, config, p)) for p, config in enumerate(some)]
    return torch.tensor(found, dtype=torch.float64)


def best_lengths(config: SimulateSettings, rounds: int = ROUNDS, candidates: int = CANDIDATES) -> Found:
    """The best constant rest lengths of an experiment, over its arm's nominal ones, their total free.

    They are looked for within `REACH` and the experiment's `bounds`, on its training set-points. The nominal lengths
    are tried too.

    Args:
        config: Any dynamic experiment, on any arm; its law is left out.
        rounds, candidates: How many rounds, of how many candidates.
    """
    fixed = training(config.changed(controller=config.controller.changed(adaptive=False)))
    build, n = Builder(fixed), fixed.arm.n_sections
    given = (fixed.bounds.lower, fixed.bounds.upper)
    limits = (end if bound is None else bound for bound, end in zip(given, REACH, strict=True))
    lower, upper = (build.vector("bounds", each, n).double().cpu() for each in limits)
    lower, upper = lower.clamp(min=REACH[0]), upper.clamp(max=REACH[1])
    nominal = fixed.arm.rest_lengths().double()
    span = (upper - lower)[:-1]

    def shares(points: Tensor) -> Tensor:
        # The last section takes what the others leave of the total, so that most candidates can be models of the arm.
        first = lower[:-1] + span * points[:, :-1]
        total = (TOTAL[0] + (TOTAL[1] - TOTAL[0]) * points[:, -1]) * nominal.sum()
        last = ((total - (first * nominal[:-1]).sum(-1)) / nominal[-1]).clamp(lower[-1], upper[-1])
        return torch.cat((first, last.unsqueeze(-1)), dim=-1)

    def of(points: Tensor) -> Tensor:
        return scores([_started(fixed, share.tolist()) for share in shares(points)])

    as_it_is = torch.cat(((1.0 - lower[:-1]) / span, torch.tensor([(1.0 - TOTAL[0]) / (TOTAL[1] - TOTAL[0])]).to(span)))
    point, least = best_of(of, n, as_it_is.clamp(0.0, 1.0).unsqueeze(0), rounds, candidates)
    value = tuple(shares(point.unsqueeze(0))[0].tolist())
    return Found("experiment.first_estimate", value, least, rounds * candidates)


def best_gamma(config: SimulateSettings, rounds: int = 2, candidates: int = 24) -> Found:
    """The best Gamma of Eq. (15) of an experiment, one number for all sections.

    Args:
        config: A dynamic experiment whose `adaptation` has a gamma.
        rounds, candidates: How many rounds, of how many candidates.

    Raises:
        ConfigError: Its law has no gamma.
    """
    _with_gamma(config, 1.0)
    tuned = training(config)
    low, high = (log(gamma) for gamma in GAMMAS)

    def of(points: Tensor) -> Tensor:
        return scores([_with_gamma(tuned, exp(low + (high - low) * float(p))) for p in points[:, 0]])

    point, least = best_of(of, 1, torch.tensor([[0.0], [1.0]]).double(), rounds, candidates)
    return Found("adaptation.gamma", (exp(low + (high - low) * float(point)),), least, rounds * candidates)


def with_found(config: SimulateSettings, found: Found) -> SimulateSettings:
    """The experiment with what was found, on its own set-points."""
    if found.name == "adaptation.gamma":
        return _with_gamma(config, found.value[0])
    return _started(config.changed(controller=config.controller.changed(adaptive=False)), found.value)


def _started(config: SimulateSettings, share: Sequence[float]) -> SimulateSettings:
    return config.changed(experiment=config.experiment.changed(first_estimate=tuple(share)))


def _with_gamma(config: SimulateSettings, gamma: float) -> SimulateSettings:
    if config.adaptation is None or not hasattr(config.adaptation, "gamma"):
        raise ConfigError("adaptation must be a law with a gamma where gamma is searched for")
    return config.changed(adaptation=config.adaptation.changed(gamma=gamma))
