"""How much there is to win: the least that any rest lengths could leave on the arm's true motion under one controller.

For the shape it is the best fit of the model's sections to the true backbone. For what algorithm 2 makes of the
sensors, Psi and the residuals, it is the best over the run's own rest lengths and a grid of others, each metric by
itself: no law beside it does better on this motion but for the grid's steps, and none does all of it at once. What
follows the shape in its place, as `ShapeFeedback`, may.
The grid holds lengths near the nominal ones, and any split of the arm that the sensors can tell.
"""

from __future__ import annotations

import itertools
from typing import NamedTuple

import torch
from torch import Tensor

from apcc_torch.composition.build import Builder
from apcc_torch.composition.run_settings import SimulateSettings
from apcc_torch.control.inverse_kinematics import elongation_cost
from apcc_torch.estimation.best_fit import best_fit
from apcc_torch.estimation.state_feedback import StateFeedback
from apcc_torch.experiments.dynamic import Arms, thinned
from apcc_torch.model.abscissae import decouple
from apcc_torch.shapes import broadcast
from apcc_torch.simulation.dynamic import DynamicLog
from apcc_torch.simulation.metrics import backbone_error, orientation_error

INSTANTS = 15
"""Instants of a run that are fitted, about."""
POINTS = 60
"""Backbone points of a fit."""
ROWS = 512
"""Fits side by side, about: of few runs many lengths are tried at once."""
STEPS = 5
"""Values of each rest length in the grid."""
REACH = 0.25
"""The grid goes this far from the nominal lengths, relative; the splits go farther."""
SHARES = (0.4, 0.6, 0.8, 1.0, 1.2, 1.5)
"""Shares of the nominal lengths that the sections of a split have, all but the last."""
TOTALS = (1.0, 0.9, 1.1)
"""Their total lengths, relative."""
PRICES = (0.0, 1e-3, 3e-3, 1e-2, 2e-2, 3e-2, 5e-2, 0.1, 0.2, 0.3, 0.5, 1.0, 3.0)
"""m of shape error that a metre of Psi is worth, along the trade-off."""


class Limits(NamedTuple):
    """The least values at S instants of R runs, each by itself.

    shape: (S, R) m, the oracle's. psi: (S, R) m, linear: (S, R, k) m and angular: (S, R, k) rad, over the grid of rest
    lengths. front: (P, 2, S, R) shape error and Psi, m, of the rest lengths that are best at each price of `PRICES`.
    share: (S,) of the time that an instant stands for; means over time are weighed by it.
    """

    shape: Tensor
    psi: Tensor
    linear: Tensor
    angular: Tensor
    front: Tensor
    share: Tensor

    def rows(self, index: list[int]) -> Limits:
        """Some runs alone."""
        return Limits(
            self.shape[:, index], self.psi[:, index], self.linear[:, index], self.angular[:, index],
            self.front[..., index], self.share,
        )  # fmt: skip

    def mean(self, value: Tensor) -> float:
        """Mean of a value (S, R, ...) over time, runs and all else."""
        weighed: Tensor = self.share.reshape(-1, *[1] * (value.dim() - 1)) * value
        return float(weighed.sum(0).mean())

    def metrics(self) -> dict[str, float]:
        """Flat metrics under the names of the runs' own."""
        values: dict[str, Tensor | float] = {
            "shape_error_mean_mm": 1e3 * self.mean(self.shape),
            "shape_error_max_mm": 1e3 * self.shape.max(),
            "shape_error_min_mm": 1e3 * self.shape.min(),
            "psi_mean_cm": 1e2 * self.mean(self.psi),
            "psi_max_cm": 1e2 * self.psi.max(),
            "psi_min_cm": 1e2 * self.psi.min(),
            "sensor_error_linear_mean_mm": 1e3 * self.mean(self.linear),
            "sensor_error_angular_mean_rad": self.mean(self.angular),
        }
        for i in range(self.linear.shape[-1]):
            values[f"sensor_{i + 1}_error_linear_mean_mm"] = 1e3 * self.mean(self.linear[..., i])
            values[f"sensor_{i + 1}_error_angular_mean_rad"] = self.mean(self.angular[..., i])
        return {name: float(value) for name, value in values.items()}

    def trade_off(self) -> list[tuple[float, float]]:
        """(mean shape error in mm, mean Psi in cm) along the front, the cheapest Psi last."""
        return [(1e3 * self.mean(shape), 1e2 * self.mean(psi)) for shape, psi in self.front]


def length_grid(build: Builder) -> Tensor:
    """(G, n_b) rest lengths, m: splits of several total lengths, and evenly around the nominal ones."""
    nominal = build.rest_lengths()
    shares = torch.linspace(1.0 - REACH, 1.0 + REACH, STEPS, dtype=nominal.dtype, device=nominal.device)
    around = torch.cartesian_prod(*[shares] * len(nominal)).reshape(-1, len(nominal)) * nominal
    # The nominal lengths are among them: the limit of a metric is never above what the fixed model reaches.
    return torch.cat((*(splits(total * nominal, build.sensors_at()) for total in TOTALS), around))


def splits(nominal: Tensor, abscissae: Tensor) -> Tensor:
    """(M, n_b) rest lengths, m: the nominal ones, then every split of their sum by `SHARES` that sensors can tell.

    For every section there must be a sensor of its own in it or in the next one, as a spline needs a point for every
    knot (the condition of Schoenberg and Whitney). Otherwise one section is bent at will and its neighbour unbends it.

    Args:
        nominal: (n_b,) m.
        abscissae: (k,) of the sensors, m, increasing.
    """
    n_b = len(nominal)
    shares = list(itertools.product(SHARES, repeat=n_b - 1))
    combined = nominal.new_tensor(shares).reshape(len(shares), n_b - 1)
    first = nominal[:-1] * combined
    made = torch.cat((first, nominal.sum() - first.sum(-1, keepdim=True)), dim=-1)
    kept = (made[:, -1] > 0) & _told_apart(made, abscissae) & (combined != 1.0).any(-1)
    return torch.cat((nominal.unsqueeze(0), made[kept]))


def _told_apart(lengths: Tensor, abscissae: Tensor) -> Tensor:
    """(M,) whether sensors at `abscissae` (k,) tell the sections of `lengths` (M, n_b) from each other."""
    n_b = lengths.shape[-1]
    ends = torch.nn.functional.pad(lengths.cumsum(-1), (1, 1))
    ends[..., -1] = torch.inf  # nothing follows the last section
    told = torch.zeros_like(ends[..., 0], dtype=torch.bool)
    for X in itertools.combinations(abscissae.tolist(), n_b):
        at = abscissae.new_tensor(X)
        told = told | ((ends[..., :n_b] < at) & (ends[..., 2:] > at)).all(-1)
    return told


def patient_feedback(build: Builder) -> StateFeedback:
    """Algorithm 2 of the settings, with time for rest lengths that are far from those of the first guess."""
    feedback = build.controller(adaptive=False).feedback
    feedback.max_iterations = 25  # from another model's q_bar, they need more than a control step's few
    return feedback


def _inferred(feedback: StateFeedback, q: Tensor, pi: Tensor, T: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """q_bar and the sensors' linear and angular errors under rest lengths pi (..., n_b), which broadcast with q."""
    batch = broadcast(q.shape[:-1], pi.shape[:-1])
    estimate = feedback(q.expand(*batch, -1), pi.expand(*batch, -1), T)
    angular = orientation_error(feedback.backbone, estimate.q_bar, pi, feedback.abscissae, T[..., :3, :3])
    return estimate.q_bar, estimate.linear_error, angular


def limits(config: SimulateSettings, log: DynamicLog, arms: Arms) -> Limits:
    """The limits of a run's motion, with the algorithm 2 that its settings name.

    Args:
        config: The run's settings.
        log: Its log.
        arms: Its arms.
    """
    build = Builder(config)
    feedback = patient_feedback(build)
    few = thinned(log, INSTANTS)
    with torch.inference_mode():
        true = arms.true.points(few.q_true, arms.true_lengths, POINTS)
        T = arms.true.pose(few.q_true, arms.true_lengths, *decouple(arms.sensors, arms.true_lengths))
        shape = best_fit(arms.model, true, few.q_bar, few.pi_hat).error
        estimate: list[tuple[Tensor, ...]] = []
        side_by_side = max(1, ROWS // few.q_bar[..., 0].numel())
        # The lengths that the controller had at these instants are among them: it is never below its own limit.
        for pi in (few.pi_hat.unsqueeze(0), *length_grid(build)[:, None, None].split(side_by_side)):
            q, linear, angular = _inferred(feedback, few.q_bar, pi, T)
            error = backbone_error(arms.true, few.q_true, arms.true_lengths, arms.model, q, pi, POINTS)
            estimate.append((error, elongation_cost(q), linear, angular))
        errors, psi, linear, angular = (torch.cat(column) for column in zip(*estimate, strict=True))
        front = []
        for price in PRICES:
            best = (errors + price * psi).argmin(0, keepdim=True)
            front.append(torch.stack((errors.gather(0, best)[0], psi.gather(0, best)[0])))
    # An instant stands for the time half way to its neighbours, the first one from the start, the last one to the end.
    edges = torch.cat((log.time[:1], 0.5 * (few.time[1:] + few.time[:-1]), few.time[-1:]))
    share = edges.diff() / (edges[-1] - edges[0])
    return Limits(
        torch.minimum(shape, errors.amin(0)), psi.amin(0), linear.amin(0), angular.amin(0), torch.stack(front), share
    )
