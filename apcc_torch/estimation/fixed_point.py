"""How the fixed point of algorithm 2 moves with the rest lengths: its exact first derivative, in closed form.

Where the iteration ends a gradient is zero: in modes "pose" and "position" that of a cost c(q, pi), half the weighted
squares of Eq. (30) or Eq. (32). With its second derivatives,

    dq_bar/dpi = -c_qq^-1 c_qpi,   c_qq = J^T W^2 J + what the residual adds.

The steps of Eq. (31) have the Gauss-Newton matrix J^T W^2 J alone, which is all of c_qq only where no residual is left.
In mode "hierarchical" two gradients are zero: that of the positions' cost c, and of the orientations' cost d the part
N d_q in the directions that no position sees, N their projector. N turns with q and pi. By the multipliers lambda, with
J_p^T lambda = -d_q, that adds the second derivatives of the positions along lambda to those of d.

A sensor's cost is a function of its frame on the model. Its derivatives along body twists of the frame are written out
here, and `KinematicModel.second_order` takes them to the coordinates.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor
from torch.nn.functional import pad

from apcc_torch.estimation.fit import Problem, twists
from apcc_torch.lie import se3, so3
from apcc_torch.lie.log_slope import left_jacobian_inverse_slope
from apcc_torch.linalg import solve_floored, solve_spd
from apcc_torch.model.kinematic_model import KinematicModel, Placed
from apcc_torch.modes import full_precision, none_left

# Of what no sensor sees, far below any sensor's reach squared, m^2: q_bar does not move along such directions.
UNSEEN = 1e-10
# The same of orientations, rad^2, in the directions that positions leave free.
UNTURNED = 1e-8


class Costs(NamedTuple):
    """Functions of the sensors' frames on the model, by the body twists of those frames, rad and m.

    gradient: (..., k, 6).
    slope: (..., k, 6, 6) of the gradient, in the axes of the moved frame.
    step: (..., k, 6, 6) what the steps of algorithm 2 take for the slope: never negative.
    """

    gradient: Tensor
    slope: Tensor
    step: Tensor


class Curvature(NamedTuple):
    """Second derivatives of a sum of costs.

    hessian: (..., n, n) by q twice. step: (..., n, n) what the steps take for it.
    mixed: (..., n, n_b) by q and pi.
    """

    hessian: Tensor
    step: Tensor
    mixed: Tensor


@full_precision
def fixed_point_slope(
    backbone: KinematicModel, mode: str, q: Tensor, pi: Tensor, X: Tensor, problem: Problem, chain: Placed
) -> Tensor:
    """dq_bar/dpi (..., n, n_b), in double precision; unchecked.

    A fixed point attracts where its second derivatives are positive definite on what the sensors see. A row where they
    are not has no derivative, and gets that of one step of algorithm 2: the residual's share of c_qq left out.

    Args:
        backbone: The model.
        mode: As in `StateFeedback`.
        q: (..., n) q_bar.
        pi: (..., n_b) m.
        X: (..., k) where the sensors are, m.
        problem: The sensors.
        chain: The model's at (q, pi) to the sensors; of a larger leading shape, so is the result.
    """
    twist, k = twists(chain, mode, problem)
    if mode == "pose":
        return -_solved(_curvature(backbone, q, pi, X, problem, chain, pose_costs(twist, k, problem)), UNSEEN)[0]
    angular, linear = twist.split_with_sizes((3, 3), dim=-1)
    c = _curvature(backbone, q, pi, X, problem, chain, position_costs(linear, problem.weights[..., 5, :]))
    first, inverse = _solved(c, UNSEEN)
    if mode == "position":
        return -first
    weights = problem.weights.squeeze(-1)
    J_w, J_p = (part.flatten(-3, -2) for part in (chain.body_jacobian() * problem.weights).split_with_sizes((3, 3), -2))
    pulled = J_w.mT @ (weights[..., :3] * angular).flatten(-2).unsqueeze(-1)  # -d_q
    multipliers = (J_p @ (inverse @ pulled)).squeeze(-1).unflatten(-1, (-1, 3))
    d = _curvature(backbone, q, pi, X, problem, chain, orientation_costs(angular, k, weights[..., :1], multipliers))
    N = UNSEEN * inverse
    N = N @ N  # what is left of directions that positions do see is far below what orientations see
    free = Curvature(N @ d.hessian @ N, N @ d.step @ N, N @ (d.mixed - d.hessian @ first))
    return -first - N @ _solved(free, UNTURNED)[0]


@full_precision
def cost_slope(backbone: KinematicModel, mode: str, q: Tensor, problem: Problem) -> Tensor:
    """c_qq (..., n, n) of the modes "pose" and "position", in closed form; unchecked.

    Args:
        backbone: The model.
        mode: One of the two.
        q: (..., n).
        problem: The sensors.
    """
    chain = backbone.chain_to(q, problem.points)
    twist, k = twists(chain, mode, problem)
    if mode == "pose":
        costs = pose_costs(twist, k, problem)
    else:
        costs = position_costs(twist[..., 3:], problem.weights[..., 5, :])
    # Of what slides with the rest lengths nothing is asked.
    pi = q.new_zeros(*q.shape[:-1], backbone.n_sections)
    return backbone.second_order(q, pi, problem.points, chain, costs.gradient, costs.slope).hessian.sum(-3)


def position_costs(linear: Tensor, weight: Tensor) -> Costs:
    """Half the squares of residuals (..., k, 3) m in the frames' own axes, weights (..., k, 1) zero or one."""
    # As the frame moves the residual falls; as the frame turns the residual turns the other way.
    turned = so3.hat(-linear)
    rows = torch.cat((turned, torch.eye(3, dtype=linear.dtype, device=linear.device).expand_as(turned)), dim=-1)
    slope = pad(weight.unsqueeze(-1) * rows, (0, 0, 3, 0))
    return Costs(pad(-weight * linear, (3, 0)), slope, torch.diag_embed(pad(weight.expand_as(linear), (3, 0))))


def pose_costs(twist: Tensor, k: Tensor, problem: Problem) -> Costs:
    """Half the weighted squares of the twists (..., k, 6) of Eq. (30), k as in `Fit`."""
    squares = problem.weights.square()
    identity = torch.eye(6, dtype=twist.dtype, device=twist.device).expand(*twist.shape, 6)
    inverse = se3.left_jacobian_inverse_times(twist, k, identity)  # a body twist takes its product with this off V
    pulled = squares.squeeze(-1) * twist
    step = inverse.mT @ (squares * inverse)
    slope = step + left_jacobian_inverse_slope(twist, k, pulled) @ inverse
    # Without an orientation there is no logarithm but a distance.
    alone = position_costs(twist[..., 3:], squares[..., 5, :])
    oriented = problem.oriented[..., None, None]
    gradient = -(inverse.mT @ pulled.unsqueeze(-1)).squeeze(-1)
    both = zip((slope, step), (alone.slope, alone.step), strict=True)
    return Costs(gradient, *(torch.where(oriented, with_log, without) for with_log, without in both))


def orientation_costs(angular: Tensor, k: Tensor, weight: Tensor, multipliers: Tensor) -> Costs:
    """Half the squares of residuals (..., k, 3) rad, weights (..., k, 1) zero or one, k as in `Fit`.

    With them the positions along multipliers (..., k, 3), in the frames' own axes.
    """
    half = so3.hat(0.5 * angular)
    identity = torch.eye(3, dtype=angular.dtype, device=angular.device)
    inverse = identity - half + k.unsqueeze(-1) * (half @ half)
    columns = torch.cat((weight.unsqueeze(-1) * inverse, so3.hat(multipliers)), dim=-2)
    step = torch.diag_embed(pad(weight.expand_as(angular), (0, 3)))
    return Costs(torch.cat((-weight * angular, multipliers), dim=-1), pad(columns, (0, 3)), step)


def _curvature(
    backbone: KinematicModel, q: Tensor, pi: Tensor, X: Tensor, problem: Problem, chain: Placed, costs: Costs
) -> Curvature:
    of_points = backbone.second_order(q, pi, problem.points, chain, costs.gradient, costs.slope)
    hessian, body = of_points.hessian.sum(-3), chain.body_jacobian()
    # A longer section moves what it carries as a larger elongation would, and slides the points along their sections.
    slid = of_points.slide.mT @ problem.points.slides(pi, X)
    return Curvature(
        hessian, (body.mT @ costs.step @ body).sum(-3), hessian[..., backbone.coordinates.elongations] + slid
    )


def _solved(c: Curvature, floor: float) -> tuple[Tensor, Tensor]:
    """hessian^-1 mixed (..., n, n_b) in the directions that the steps see, and (step + floor I)^-1 (..., n, n).

    In the others the second derivatives are as small as the residual of a fixed point that is not quite reached, of
    either sign, and say nothing. In rows whose hessian is not positive definite, step^-1 mixed.
    """
    identity = torch.eye(c.step.shape[-1], dtype=c.step.dtype, device=c.step.device)
    inverse = solve_spd(c.step + floor * identity, identity.expand_as(c.step))
    unseen = floor * inverse
    seen = identity - unseen
    mixed = seen @ c.mixed
    exact = solve_floored(seen @ c.hessian @ seen, mixed, floor)
    lost = torch.isnan(exact).any(-1, keepdim=True).any(-2, keepdim=True)
    if not none_left(lost):
        exact = torch.where(lost, inverse @ (mixed + unseen @ mixed), exact)
    return seen @ exact, inverse
