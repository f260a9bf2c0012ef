"""One evaluation of the model against the sensors: what each iteration of algorithm 2 compares and steps from."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from apcc_torch.estimation.step import Residual
from apcc_torch.lie import se3, so3
from apcc_torch.model.abscissae import MaterialPoints
from apcc_torch.model.kinematic_model import KinematicModel, Placed


class Problem(NamedTuple):
    """What stays the same during the iterations, all of one leading shape.

    rotation: (..., k, 3, 3) and position: (..., k, 3) m, the measured poses, zero where not usable.
    points: The sensors on the model.
    usable, oriented: (..., k) bool, sensors and orientations that count.
    weights: (..., k, 6, 1) weights of the rows of a step, see `step.Residual`.
    """

    rotation: Tensor
    position: Tensor
    points: MaterialPoints
    usable: Tensor
    oriented: Tensor
    weights: Tensor


class Fit(NamedTuple):
    """The model at q beside the sensors.

    q: (..., n).
    twist: (..., k, 6) from model to sensor, angular (rad) over linear (m), zero where not used.
    k: (..., k, 1) of the twist, see `so3.half_log`; 0 where the mode takes no logarithm.
    body: (..., k, 6, n) body Jacobians.
    """

    q: Tensor
    twist: Tensor
    k: Tensor
    body: Tensor

    def squares(self) -> tuple[Tensor, Tensor]:
        """Squared norms (..., k) of the angular (rad^2) and linear (m^2) parts."""
        angular, linear = self.twist.square().unflatten(-1, (2, 3)).sum(-1).unbind(-1)
        return angular, linear

    def errors(self) -> tuple[Tensor, Tensor]:
        """Norms (..., k) of the angular (rad) and linear (m) parts."""
        angular, linear = torch.linalg.vector_norm(self.twist.unflatten(-1, (2, 3)), dim=-1).unbind(-1)
        return angular, linear

    def residual(self, mode: str, weights: Tensor) -> Residual:
        """What a step of the mode has to remove; weights as in `Problem`."""
        body = self.body
        if mode == "pose":
            # log(exp(-d) exp(V)) = V - J_l^-1(V) d: with J_b alone, right at V = 0, a step near the best fit of sensors
            # that do not fit is no descent, and the estimate would stop short by up to a milliradian.
            body = se3.left_jacobian_inverse_times(self.twist, self.k, body)
        return Residual(self.twist.unsqueeze(-1), body, weights)


def evaluate(backbone: KinematicModel, mode: str, q: Tensor, problem: Problem) -> Fit:
    """The model at q (..., n) beside the sensors; mode as in `StateFeedback`."""
    chain = backbone.chain_to(q, problem.points)
    return Fit(q, *twists(chain, mode, problem), chain.body_jacobian())


def twists(chain: Placed, mode: str, problem: Problem) -> tuple[Tensor, Tensor]:
    """`Fit.twist` and `Fit.k` of a chain to the sensors."""
    into_body = chain.rotation.mT
    offset = torch.where(problem.usable.unsqueeze(-1), problem.position - chain.tip, 0.0)
    linear = (into_body @ offset.unsqueeze(-1)).squeeze(-1)  # Eq. (32), in the sensor's own axes
    if mode == "position":
        return torch.nn.functional.pad(linear, (3, 0)), torch.zeros_like(linear[..., :1])
    identity = torch.eye(3, dtype=linear.dtype, device=linear.device)
    turn = into_body @ problem.rotation
    half, k = so3.half_log(torch.where(problem.oriented[..., None, None], turn, identity))
    # The linear part of Eq. (30) depends on the orientation, which has no say where positions come first.
    hierarchical = mode == "hierarchical"
    return torch.cat((2.0 * half, linear), dim=-1) if hierarchical else se3.log_from_half(half, k, linear), k


def select(take: Tensor, new: Fit, old: Fit) -> Fit:
    """Row by row the new or the old fit; take (...) bool."""
    row, matrix, stack = (take[(..., *(None,) * extra)] for extra in (1, 2, 3))
    return Fit(
        torch.where(row, new.q, old.q),
        torch.where(matrix, new.twist, old.twist),
        torch.where(matrix, new.k, old.k),
        torch.where(stack, new.body, old.body),
    )
