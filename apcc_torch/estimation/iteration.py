"""The iteration of algorithm 2: damped steps with a bound on their length, row by row accepted, frozen and settled."""

from __future__ import annotations

from typing import NamedTuple, Protocol

import torch
from torch import Tensor

from apcc_torch.estimation.fit import Fit, Problem, evaluate, select
from apcc_torch.estimation.measured_bends import measured_bends
from apcc_torch.estimation.step import damped_step
from apcc_torch.linalg import solve_spd
from apcc_torch.model.kinematic_model import KinematicModel
from apcc_torch.modes import none_left
from apcc_torch.repetition import repeated
from apcc_torch.settings import Setting, aligned

# A seed that is farther off at a sensor, rad and of the sensor's distance along the arm, has lost its way: the shortest
# way back may be the wrong way round.
LOST_ANGLE, LOST_SHARE = 2.0, 0.75
# A direction of q that moves no sensor by more than the root of this, m or weighted rad per unit, is unseen.
UNSEEN = 1e-8


class Rules(Protocol):
    """The settings that the iteration reads of a `StateFeedback`."""

    mode: str
    angular_weight: Setting
    max_iterations: int
    min_iterations: int
    linear_threshold: Setting
    angular_threshold: Setting
    bend_step: Setting
    length_step: Setting
    damping: Setting
    settled_step: Setting


class Outcome(NamedTuple):
    """How the rows ended.

    fit: The best fit found. Its twist is the one at its q; of a row whose last step was taken on trust, `body` and `k`
        are those before that step.
    within: (...) bool, every sensor is within both thresholds.
    settled: (...) bool, the last step was negligible.
    valid: (...) bool, there was something to fit.
    iterations: (...) int64 steps computed.
    """

    fit: Fit
    within: Tensor
    settled: Tensor
    valid: Tensor
    iterations: Tensor


class _Scored(NamedTuple):
    """A fit and how good it is."""

    fit: Fit
    cost: Tensor  # (...) m^2
    position_cost: Tensor  # (...) m^2
    within: Tensor  # (...) bool, both thresholds are met


class _Now(NamedTuple):
    """Where the iteration is."""

    best: _Scored
    damping: Tensor  # (...) m^2
    live: Tensor  # (...) bool, has not ended
    settled: Tensor  # (...) bool, the last step was negligible
    iterations: Tensor  # (...) int64, steps computed


class _Step(NamedTuple):
    """A step and what it promises."""

    step: Tensor  # (..., n)
    twist: Tensor  # (..., k, 6) after the step, to first order
    negligible: Tensor  # (...) bool


def _score(rules: Rules, fit: Fit) -> _Scored:
    angular, linear = fit.squares()
    cost = (linear + aligned(rules.angular_weight, 1) ** 2 * angular).sum(-1)
    position_cost = linear.sum(-1) if rules.mode == "hierarchical" else cost
    inside = (linear < aligned(rules.linear_threshold, 1) ** 2) & (angular < aligned(rules.angular_threshold, 1) ** 2)
    return _Scored(fit, cost, position_cost, inside.all(-1))


def _step(rules: Rules, fit: Fit, weights: Tensor, damping: Tensor, limits: Tensor, lowest: Tensor) -> _Step:
    residual = fit.residual(rules.mode, weights)
    step = damped_step(rules.mode, residual, damping)
    size = step.abs()
    step = step / (size / limits).amax((-1, -2), keepdim=True).clamp(min=1.0)
    step = torch.maximum(step, (lowest - fit.q).unsqueeze(-1))
    after = torch.where(weights > 0.0, residual.twists - residual.body @ step.unsqueeze(-3), 0.0)
    return _Step(step.squeeze(-1), after.squeeze(-1), size.amax((-1, -2)) < rules.settled_step)


def far_off(fit: Fit, problem: Problem) -> Tensor:
    """(...) bool, whether a sensor is so far off that the way to it is not the one that the twist tells."""
    angular, linear = fit.squares()
    return ((angular > LOST_ANGLE**2) | (linear > (LOST_SHARE * problem.points.length.sum(-1)).square())).any(-1)


def unseen(body: Tensor, weights: Tensor) -> Tensor:
    """(...) int64, how many directions of q no row that counts sees: n less the rank of the weighted Jacobian.

    body and weights as in `step.Residual`.

    Of its singular values s each unseen one adds one to the sum of tau / (s^2 + tau), and the others next to nothing.
    """
    J = (body * weights).flatten(-3, -2)
    n = J.shape[-1]
    tau = max(UNSEEN, 32.0 * torch.finfo(J.dtype).eps)
    identity = torch.eye(n, dtype=J.dtype, device=J.device)
    inverse = solve_spd(J.mT @ J + tau * identity, identity.expand(*J.shape[:-2], n, n))
    lost = tau * inverse.diagonal(dim1=-2, dim2=-1).sum(-1)
    return torch.where(torch.isfinite(lost), torch.floor(lost + 0.5), n).to(torch.int64)


def _found(backbone: KinematicModel, step: _Step, best: _Scored, problem: Problem, lowest: Tensor) -> _Step:
    """The first step; of rows that are lost, the way to what the sensors' orientations say."""
    lost = far_off(best.fit, problem) | ((best.fit.q <= lowest).any(-1) & ~best.within)
    if none_left(lost):
        return step
    way = torch.maximum(measured_bends(backbone, problem), lowest) - best.fit.q
    return step._replace(step=torch.where(lost.unsqueeze(-1), way, step.step), negligible=step.negligible & ~lost)


def _better(rules: Rules, trial: _Scored, best: _Scored) -> Tensor:
    if rules.mode != "hierarchical":
        return trial.cost < best.cost
    # A lower position cost wins; one as good to 0.1 % (or 1 % of the threshold) lets orientation win.
    slack = 1e-3 * best.position_cost + (0.01 * rules.linear_threshold) ** 2
    as_good = trial.position_cost <= best.position_cost + slack
    return (trial.position_cost < best.position_cost - slack) | (as_good & (trial.cost < best.cost))


def _chosen(rules: Rules, take: Tensor, trial: _Scored, best: _Scored) -> _Scored:
    cost = torch.where(take, trial.cost, best.cost)
    position_cost = cost
    if rules.mode == "hierarchical":
        position_cost = torch.where(take, trial.position_cost, best.position_cost)
    return _Scored(select(take, trial.fit, best.fit), cost, position_cost, torch.where(take, trial.within, best.within))


def _first_damping(rules: Rules, floor: float, cost: Tensor) -> Tensor:
    """(...) damping of the first step, m^2, of the shape of the cost."""
    if isinstance(rules.damping, Tensor):
        return rules.damping.to(cost).clamp(min=floor).expand_as(cost)
    return torch.full_like(cost, max(rules.damping, floor))


def iterate(backbone: KinematicModel, rules: Rules, q_seed: Tensor, problem: Problem, lowest: Tensor) -> Outcome:
    """Steps from q_seed (..., n), of the problem's leading shape, until every row has ended.

    No coordinate falls below `lowest` (..., n). A row whose seed has lost its way first tries what the sensors'
    orientations say.
    """
    best = _score(rules, evaluate(backbone, rules.mode, torch.maximum(q_seed, lowest), problem))
    valid = problem.usable.any(-1) & torch.isfinite(best.cost)
    # Below this the damped normal matrix, of order one, is singular to rounding where sensors leave freedom.
    floor = 32.0 * torch.finfo(best.cost.dtype).eps
    damping = _first_damping(rules, floor, best.cost)
    limits = backbone.coordinates.per_unit(rules.bend_step, rules.length_step, q_seed.shape[-1], q_seed).unsqueeze(-1)
    live = valid
    if rules.min_iterations == 0:
        live = live & ~best.within
    none = torch.zeros_like(live)
    now = _Now(best, damping, live, none, torch.zeros_like(live, dtype=torch.int64))

    def once(now: _Now, first: bool, last: bool) -> _Now:
        best, live = now.best, now.live
        step = _step(rules, best.fit, problem.weights, now.damping, limits, lowest)
        if first:
            step = _found(backbone, step, best, problem, lowest)
        negligible = step.negligible & live
        settled = now.settled | negligible
        trial = Fit(best.fit.q + step.step, step.twist, best.fit.k, best.fit.body)
        # A negligible step that is a row's last is taken on trust, and what it leaves is what it promises: the pose's
        # twist, whose derivative is exact, keeps that promise to second order.
        trusting = last and rules.mode == "pose"
        if not (trusting and none_left(live & ~negligible)):
            trial = evaluate(backbone, rules.mode, trial.q, problem)
            if trusting:
                trial = trial._replace(twist=torch.where(negligible[..., None, None], step.twist, trial.twist))
        scored = _score(rules, trial)
        better = _better(rules, scored, best)
        take = ((better | negligible) if trusting else better) & live
        best = _chosen(rules, take, scored, best)
        damping = torch.where(take, 0.1 * now.damping, 10.0 * now.damping).clamp(min=floor)
        still = live & ~(settled | best.within) if last else live
        return _Now(best, damping, still, settled, now.iterations + live)

    # The first iteration may find a way of its own, and the last of those that are always made is the first to end.
    apart = min(rules.max_iterations, max(1, rules.min_iterations - 1))
    for k in range(apart):
        if none_left(now.live):
            break
        now = once(now, k == 0, k + 1 >= rules.min_iterations)
    now = repeated(lambda now: once(now, False, True), now, rules.max_iterations - apart, lambda now: now.live)
    best, settled = now.best, now.settled
    return Outcome(best.fit, best.within, settled, valid, now.iterations)
