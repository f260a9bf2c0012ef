"""How the sensors' noise becomes noise of the inferred configuration: the spread of algorithm 2's fixed point."""

from __future__ import annotations

import torch
from torch import Tensor

from apcc_torch.estimation.state_feedback import StateFeedback
from apcc_torch.estimation.step import Residual, damped_step, row_weights
from apcc_torch.model.abscissae import located
from apcc_torch.modes import full_precision
from apcc_torch.settings import Setting, aligned
from apcc_torch.shapes import batch_shape

# Of directions that no sensor sees, m^2; see `StateFeedback.sensitivity`.
UNSEEN = 1e-10


@full_precision
def feedback_response(
    feedback: StateFeedback,
    q_bar: Tensor,
    pi_hat: Tensor,
    mask: Tensor | None = None,
    angular_mask: Tensor | None = None,
) -> Tensor:
    """How q_bar follows the sensors' twists (..., n, k, 6), angular rad over linear m, in the sensors' own axes.

    It is one step of the mode, Eq. (31), against every twist: exact where the model fits the sensors.

    Args:
        feedback: Algorithm 2.
        q_bar: (..., n) an estimate.
        pi_hat: (..., n_b) m.
        mask, angular_mask: (..., k) bool, as in `StateFeedback.forward`.
    """
    feedback.backbone.check(q_bar, pi_hat)
    usable = torch.ones_like(feedback.abscissae, dtype=torch.bool) if mask is None else mask
    oriented = usable if angular_mask is None else usable & angular_mask
    batch = batch_shape(q_bar=(q_bar, 1), pi_hat=(pi_hat, 1), sensors=(oriented, 1), abscissae=(feedback.abscissae, 1))
    # In double precision, as `StateFeedback.sensitivity` has it.
    q, pi = (v.double().expand(*batch, v.shape[-1]) for v in (q_bar, pi_hat))
    X = feedback.abscissae.to(q)
    k = X.shape[-1]
    body = feedback.backbone.chain_to(
        q, feedback.backbone.material_points(pi, *located(X.expand(*batch, k), pi))
    ).body_jacobian()
    angular = oriented.double()
    if feedback.mode == "position":
        angular = torch.zeros_like(angular)
    elif feedback.mode == "pose":
        angular = angular * aligned(feedback.angular_weight, 1)
    weights = row_weights(angular.expand(*batch, k), usable.expand(*batch, k), q.dtype)
    twists = torch.eye(6 * k, dtype=q.dtype, device=q.device).unflatten(0, (k, 6)).expand(*batch, k, 6, 6 * k)
    damping = torch.full((), UNSEEN, dtype=q.dtype, device=q.device)
    step = damped_step(feedback.mode, Residual(twists, body, weights), damping)
    return step.unflatten(-1, (k, 6)).to(q_bar.dtype)


@full_precision
def feedback_covariance(
    feedback: StateFeedback,
    q_bar: Tensor,
    pi_hat: Tensor,
    position_noise: Setting,
    angular_noise: Setting,
    mask: Tensor | None = None,
    angular_mask: Tensor | None = None,
) -> Tensor:
    """Covariance of q_bar (..., n, n) under independent noise of the sensors.

    It is that of the directions which the sensors see. The others keep the seed whatever the noise, and have none here:
    `StateFeedback.unseen` counts them.

    Args:
        feedback: Algorithm 2.
        q_bar: (..., n) an estimate.
        pi_hat: (..., n_b) m.
        position_noise: Standard deviation of each coordinate, m, as in `simulation.sensors.PoseSensors`.
        angular_noise: Of each component of the rotation vector, rad.
        mask, angular_mask: (..., k) bool, as in `StateFeedback.forward`.

    Example:
        >>> arm = Arm(lengths=[0.2, 0.25])
        >>> feedback = StateFeedback(arm.backbone(), arm.sensor_places())
        >>> S = feedback_covariance(feedback, torch.zeros(6).double(), arm.rest_lengths(), 1e-3, 0.01)
        >>> S.diagonal().sqrt()
        tensor([0.0094, 0.0094, 0.0010, 0.0140, 0.0140, 0.0014], dtype=torch.float64)
    """
    response = feedback_response(feedback, q_bar, pi_hat, mask, angular_mask)
    angular, linear = response.split_with_sizes((3, 3), dim=-1)
    scaled = torch.cat((aligned(angular_noise, 3) * angular, aligned(position_noise, 3) * linear), dim=-1).flatten(-2)
    return scaled @ scaled.mT
