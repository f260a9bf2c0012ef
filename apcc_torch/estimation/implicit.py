"""Gradients through algorithm 2 by the implicit function theorem: one linear solve, whatever the iterations were.

Where the iteration ends, a vector F(q, theta) is zero: the gradient J_b^T W V of the cost, or in mode "hierarchical"
the step itself. So dq_bar/dtheta = -(dF/dq)^-1 dF/dtheta, with the curvature of the residual in dF/dq, which the
Gauss-Newton matrix J_b^T W J_b lacks.
"""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor
from torch.func import vjp, vmap

from apcc_torch.errors import GradientError
from apcc_torch.estimation.fit import Fit, Problem, evaluate
from apcc_torch.estimation.fixed_point import cost_slope
from apcc_torch.estimation.iteration import Outcome
from apcc_torch.estimation.step import Residual, hierarchical_step
from apcc_torch.model.abscissae import MaterialPoints
from apcc_torch.model.kinematic_model import KinematicModel
from apcc_torch.modes import full_precision

# Of what no sensor sees, far below any sensor's reach squared, m^2: such directions of q_bar get no gradient.
UNSEEN = 1e-10


def attached(backbone: KinematicModel, mode: str, outcome: Outcome, q_seed: Tensor, problem: Problem) -> Fit:
    """The fit where the iteration ended, as a function of the problem: its values are kept, its gradients implicit.

    Args:
        backbone: The model.
        mode: As in `StateFeedback`.
        outcome: Of the iteration, without a graph.
        q_seed: (..., n) what it started from.
        problem: What it solved, with the graph that gradients go into.

    Returns:
        The fit. Its q, and the norms of its twist, carry the gradients that `StateFeedback` promises; the rest of it
        carries none.
    """
    fit = outcome.fit
    if _depends(problem):
        follows = outcome.valid & (outcome.within | outcome.settled)
        fit = _moved(backbone, mode, fit, _exact(problem, follows), follows)
    if q_seed.requires_grad:
        fit = fit._replace(q=torch.where(outcome.valid.unsqueeze(-1), fit.q, q_seed))
    return fit


def _depends(problem: Problem) -> bool:
    """Whether anything of the problem asks for a gradient."""
    tensors = (problem.rotation, problem.position, *problem.points, problem.weights)
    return any(tensor.requires_grad for tensor in tensors)


def _moved(backbone: KinematicModel, mode: str, fit: Fit, problem: Problem, follows: Tensor) -> Fit:
    """The fit with its gradients; the rows that follow, of a problem that is safe for all rows."""
    q = torch.where(follows.unsqueeze(-1), fit.q, 0.0).to(torch.float64)
    here = evaluate(backbone, mode, q, problem)
    residual = here.residual(mode, problem.weights)
    measured = (problem.rotation, problem.position, *problem.points, problem.usable, problem.oriented, problem.weights)
    change = _FixedPoint.apply(_defect(mode, residual), backbone, mode, follows, q, *(v.detach() for v in measured))
    # Through q_bar the twist moves by its Jacobian there. Outside mode "pose" that lacks the turning of the axes it is
    # measured in, which no norm feels.
    twist = here.twist - (residual.body.detach() @ change[..., None, :, None]).squeeze(-1)
    return fit._replace(q=_with_gradient(fit.q, change), twist=_with_gradient(fit.twist, twist))


def _with_gradient(value: Tensor, source: Tensor) -> Tensor:
    """`value` as it is, with the gradient of `source`."""
    return value + (source - source.detach()).to(value.dtype)


def _exact(problem: Problem, follows: Tensor) -> Problem:
    """The problem in double precision, with rows that do not follow made harmless: without sensors, on any arm."""
    keep = follows.unsqueeze(-1)
    fraction, length = (torch.where(keep.unsqueeze(-1), part.double(), 1.0) for part in problem.points[:2])
    return Problem(
        problem.rotation.double(),
        problem.position.double(),
        MaterialPoints(fraction, length, problem.points.section),
        problem.usable & keep,
        problem.oriented & keep,
        problem.weights.double(),
    )


def _defect(mode: str, residual: Residual) -> Tensor:
    """F (..., n): what is zero at the fixed point."""
    if mode == "hierarchical":
        damping = torch.full((), UNSEEN, dtype=residual.body.dtype, device=residual.body.device)
        return hierarchical_step(residual, damping).squeeze(-1)
    J, r = ((part * residual.weights).flatten(-3, -2) for part in (residual.body, residual.twists))
    return (J.mT @ r).squeeze(-1)


@full_precision
def _slope(backbone: KinematicModel, mode: str, q: Tensor, problem: Problem) -> Tensor:
    """dF/dq (..., n, n), less `UNSEEN` on its diagonal, at which F falls."""
    n = q.shape[-1]
    identity = torch.eye(n, dtype=q.dtype, device=q.device)
    if mode != "hierarchical":
        return -cost_slope(backbone, mode, q, problem) - UNSEEN * identity

    def defect(at: Tensor) -> Tensor:
        return _defect(mode, evaluate(backbone, mode, at, problem).residual(mode, problem.weights))

    pulled = vjp(defect, q)[1]
    (rows,) = vmap(pulled)(identity.view(n, *[1] * (q.dim() - 1), n).expand(n, *q.shape))
    return rows.movedim(0, -2) - UNSEEN * identity


class _FixedPoint(torch.autograd.Function):
    """Zero, the change of q; its gradient goes to F through the inverse of dF/dq, computed when it is asked for."""

    generate_vmap_rule = True

    @staticmethod
    def forward(
        defect: Tensor, backbone: KinematicModel, mode: str, follows: Tensor, q: Tensor, *measured: Tensor
    ) -> Tensor:
        return torch.zeros_like(defect)

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple[Any, ...], output: Tensor) -> None:
        defect, ctx.backbone, ctx.mode, *constants = inputs
        ctx.save_for_backward(defect, *constants)

    @staticmethod
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor | None, ...]:
        defect, follows, q, *measured = ctx.saved_tensors  # asked for once, as checkpointing wants
        rotation, position, *on_model, usable, oriented, weights = measured
        points = MaterialPoints(*on_model)
        problem = Problem(rotation, position, points, usable, oriented, weights)
        with torch.no_grad():
            slope = _slope(ctx.backbone, ctx.mode, q, problem)
            # solve_ex does not raise: a row whose fixed point is singular is a constant too.
            pulled = torch.linalg.solve_ex(slope.mT, gradient.unsqueeze(-1))[0]
            pulled = torch.where(follows.unsqueeze(-1) & torch.isfinite(pulled).all(-2), -pulled.squeeze(-1), 0.0)
        return _Once.apply(pulled, defect), *[None] * (4 + len(measured))


class _Once(torch.autograd.Function):
    """A gradient that says so where it is differentiated again: dF/dq was taken as a constant."""

    generate_vmap_rule = True

    @staticmethod
    def forward(pulled: Tensor, defect: Tensor) -> Tensor:
        return pulled.clone()

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple[Tensor, ...], output: Tensor) -> None:
        pass

    @staticmethod
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor, Tensor]:
        raise GradientError('second derivatives of q_bar need StateFeedback(..., gradient="unrolled")')
