"""The iteration of algorithm 2: damped steps with a bound on their length, row by row accepted, frozen and settled."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from apcc_torch.estimation.fit import Fit, Problem, evaluate, select
from apcc_torch.estimation.step import Residual, damped_step
from apcc_torch.lie import se3
from apcc_torch.model.backbone import PCCBackbone
from apcc_torch.settings import Setting, aligned


class Rules(NamedTuple):
    """Settings of the iteration; see `StateFeedback`."""

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


def _step(rules: Rules, fit: Fit, weights: Tensor, damping: Tensor, limits: Tensor) -> _Step:
    body = fit.body
    if rules.mode == "pose":
        # log(exp(-d) exp(V)) = V - J_l^-1(V) d: with J_b alone, right at V = 0, a step near the best fit of sensors
        # that do not fit is no descent, and the estimate would stop short by up to a milliradian.
        body = se3.left_jacobian_inverse_times(fit.twist, fit.k, body)
    twist = fit.twist.unsqueeze(-1)
    step = damped_step(rules.mode, Residual(twist, body, weights), damping)
    size = step.abs()
    step = step / (size / limits).amax((-1, -2), keepdim=True).clamp(min=1.0)
    after = torch.where(weights > 0.0, twist - body @ step.unsqueeze(-3), 0.0)
    return _Step(step.squeeze(-1), after.squeeze(-1), size.amax((-1, -2)) < rules.settled_step)


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


def _limits(rules: Rules, like: Tensor) -> Tensor:
    """(..., n, 1) largest change of each configuration variable in one step."""
    sections, bend, length = like.shape[-1] // 3, rules.bend_step, rules.length_step
    if isinstance(bend, Tensor) or isinstance(length, Tensor):
        bends, lengths = (torch.as_tensor(v, dtype=like.dtype, device=like.device) for v in (bend, length))
        of_section = torch.stack(torch.broadcast_tensors(bends, bends, lengths), dim=-1)
        return of_section.unsqueeze(-2).expand(*of_section.shape[:-1], sections, 3).flatten(-2).unsqueeze(-1)
    bends = torch.full((sections, 2), bend, dtype=like.dtype, device=like.device)
    return torch.nn.functional.pad(bends, (0, 1), value=length).reshape(-1, 1)


def _first_damping(rules: Rules, floor: float, cost: Tensor) -> Tensor:
    """(...) damping of the first step, m^2, of the shape of the cost."""
    if isinstance(rules.damping, Tensor):
        return rules.damping.to(cost).clamp(min=floor).expand_as(cost)
    return torch.full_like(cost, max(rules.damping, floor))


def _none(rows: Tensor) -> bool:
    """Whether no row is left. That reads a value, so a compiled step goes on with all its rows frozen instead."""
    return not torch.compiler.is_compiling() and not bool(rows.any())


def iterate(backbone: PCCBackbone, rules: Rules, q_seed: Tensor, problem: Problem) -> Outcome:
    """Steps from q_seed (..., 3 n_b), of the problem's leading shape, until every row has ended."""
    best = _score(rules, evaluate(backbone, rules.mode, q_seed, problem))
    valid = problem.usable.any(-1) & torch.isfinite(best.cost)
    # Below this the damped normal matrix, of order one, is singular to rounding where sensors leave freedom.
    floor = 32.0 * torch.finfo(best.cost.dtype).eps
    damping = _first_damping(rules, floor, best.cost)
    limits = _limits(rules, q_seed)
    live = valid
    if rules.min_iterations == 0:
        live = live & ~best.within
    settled = torch.zeros_like(live)
    iterations = torch.zeros_like(live, dtype=torch.int64)
    for k in range(rules.max_iterations):
        if _none(live):
            break
        last = k + 1 >= rules.min_iterations
        step = _step(rules, best.fit, problem.weights, damping, limits)
        negligible = step.negligible & live
        iterations = iterations + live
        settled = settled | negligible
        trial = Fit(best.fit.q + step.step, step.twist, best.fit.k, best.fit.body)
        # A negligible step that is a row's last is taken on trust, and what it leaves is what it promises: the pose's
        # twist, whose derivative is exact, keeps that promise to second order.
        trusting = last and rules.mode == "pose"
        if not (trusting and _none(live & ~negligible)):
            trial = evaluate(backbone, rules.mode, trial.q, problem)
            if trusting:
                trial = trial._replace(twist=torch.where(negligible[..., None, None], step.twist, trial.twist))
        scored = _score(rules, trial)
        better = _better(rules, scored, best)
        take = ((better | negligible) if trusting else better) & live
        best = _chosen(rules, take, scored, best)
        if last:
            live = live & ~(settled | best.within)
        damping = torch.where(take, 0.1 * damping, 10.0 * damping).clamp(min=floor)
    return Outcome(best.fit, best.within, settled, valid, iterations)
