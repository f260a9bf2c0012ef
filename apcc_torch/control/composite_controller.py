"""A controller with a model of the dynamics around the kinematic one: a feed-forward force beside the tendon lengths.

The kinematic controller adapts the rest lengths, the law of the dynamics what the arm weighs and how stiff it is; with
both it is the composite controller that the paper leaves to further work.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from apcc_torch.control.adaptive_dynamics import AdaptiveDynamics, DynamicsEstimate
from apcc_torch.control.bounds import within
from apcc_torch.control.controller import APCCController
from apcc_torch.control.step_io import Command, ControllerState, Measurement, Target
from apcc_torch.errors import ConfigError
from apcc_torch.estimation.state_feedback import StateFeedback
from apcc_torch.linalg import damped_pseudo_inverse
from apcc_torch.model.dynamics_regressor import DynamicsRegressor
from apcc_torch.model.kinematic_model import KinematicModel
from apcc_torch.model.tendons import TendonRouting
from apcc_torch.part import Part, check_settings, check_settings_or_zero
from apcc_torch.shapes import check_tensor


class CompositeState(NamedTuple):
    """Everything a `CompositeController` remembers between steps.

    kinematic: The kinematic controller's state.
    dynamics: What is known of the dynamics.
    rate: (..., n) reference velocity, the filtered rate of q_d, rad/s and m/s.
    """

    kinematic: ControllerState
    dynamics: DynamicsEstimate
    rate: Tensor

    @property
    def q_bar(self) -> Tensor:
        """(..., n) last inferred configuration."""
        return self.kinematic.q_bar

    @property
    def q_d(self) -> Tensor:
        """(..., n) desired configuration."""
        return self.kinematic.q_d

    @property
    def pi_hat(self) -> Tensor:
        """(..., n_b) rest lengths, m."""
        return self.kinematic.pi_hat

    @property
    def theta_hat(self) -> Tensor:
        """(..., 5) parameters of the dynamics, as `dynamics_regressor.PARAMETERS`."""
        return self.dynamics.theta_hat


class CompositeController(Part):
    """`APCCController` with a feed-forward u = B_hat(pi_hat)^+ (Y_d theta_hat - K_s s), added to the tendon loop.

    The references of Y_d come from q_d: its rate behind a low-pass, v, with that filter's own acceleration, both with
    Lambda (q_bar - q_d) taken off, so that s = qdot_bar - v + Lambda (q_bar - q_d). Gravity is taken where the arm is,
    elasticity at q_d: the arm's own stiffness then helps to hold it there, and no noise is fed back through it.

    The measurement's `forces` are the tendon forces at its stamp; without them only s adapts.

    Args:
        kinematic: Gives q_bar, qdot_bar, pi_hat, q_d. With a routing and a model of constant-curvature sections.
        regressor: Y_d.
        law: theta_hat.
        stiffness: Lambda, 1/s.
        damping: K_s on the bends, N m s/rad, and, over 1 m^2, on the elongations, N s/m.
        reference_time: Time constant of the low-pass on the rate of q_d, s.
        pseudo_damping: Damping of the pseudo-inverse of B_hat, in the units of B (m per rad, and 1).
        force_limit: Bound on each tendon's feed-forward, N; None for no bound.

    Raises:
        ConfigError: The controller has no routing.
        ValueRangeError: A setting is out of range.
    """

    def __init__(
        self,
        kinematic: APCCController,
        regressor: DynamicsRegressor,
        law: AdaptiveDynamics,
        stiffness: float = 1.0,
        damping: float = 0.0,
        reference_time: float = 0.1,
        pseudo_damping: float = 1e-3,
        force_limit: float | None = None,
    ) -> None:
        super().__init__()
        if kinematic.routing is None:
            raise ConfigError("a controller with a model of the dynamics needs a tendon routing")
        check_settings(reference_time=reference_time, pseudo_damping=pseudo_damping, force_limit=force_limit)
        check_settings_or_zero(stiffness=stiffness, damping=damping)
        self.kinematic = kinematic
        self.dynamics = regressor
        self.law = law
        self.stiffness = stiffness
        self.damping = damping
        self.reference_time = reference_time
        self.pseudo_damping = pseudo_damping
        self.force_limit = force_limit

    @property
    def backbone(self) -> KinematicModel:
        """The model."""
        return self.kinematic.backbone

    @property
    def feedback(self) -> StateFeedback:
        """Algorithm 2."""
        return self.kinematic.feedback

    @property
    def routing(self) -> TendonRouting | None:
        """The tendons."""
        return self.kinematic.routing

    def tendons(self, q: Tensor, pi_hat: Tensor) -> Tensor | None:
        """See `APCCController.tendons`."""
        return self.kinematic.tendons(q, pi_hat)

    def initial_state(self, q: Tensor, pi_hat: Tensor, time: Tensor | None = None) -> CompositeState:
        """State before the first measurement; arguments as `APCCController.initial_state`."""
        state = self.kinematic.initial_state(q, pi_hat, time)
        return CompositeState(state, self.law.initial_estimate(state.q_bar), torch.zeros_like(state.q_bar))

    def forward(
        self, state: CompositeState, measurement: Measurement, target: Target
    ) -> tuple[CompositeState, Command]:
        """One control step; see `APCCController.forward`. The command's `force` is the feed-forward.

        Args:
            state: From `initial_state` or the last step.
            measurement: Sensor poses, their stamp, and the tendon forces.
            target: Desired position and velocity.
        """
        before = state.kinematic
        later, command = self.kinematic(before, measurement, target)
        q, qdot, pi_hat, q_d = later.q_bar, later.qdot_bar, later.pi_hat, later.q_d
        dt = (later.time - before.time).clamp(0.0, self.kinematic.integration_limit).to(q.dtype)
        elapsed, step = (dt > 0).unsqueeze(-1), dt.clamp(min=1e-9).unsqueeze(-1)
        share = 1.0 - torch.exp(-dt / self.reference_time).unsqueeze(-1)
        rate = torch.lerp(state.rate, torch.where(elapsed, (q_d - before.q_d) / step, 0.0), share)
        off = q - q_d
        v = rate - self.stiffness * off
        a = torch.where(elapsed, (rate - state.rate) / step, 0.0) - self.stiffness * (qdot - rate)
        s = qdot - v
        # Behind the law's low-pass a difference is what it was integrated from: no rate of q_bar has to be right.
        moved = torch.where(elapsed, (q - before.q_bar) / step, 0.0)
        swung = torch.where(elapsed, (qdot - before.qdot_bar) / step, 0.0)
        # The motion that is wanted and the one that was measured, side by side.
        pairs = [torch.stack(torch.broadcast_tensors(*pair)) for pair in ((v, moved), (a, swung), (q_d, q))]
        both = self.dynamics(q, qdot, pairs[0], pairs[1], pi_hat, pairs[2])
        B = self.kinematic.backbone.tendon_matrix(self.dynamics.routing, pi_hat)
        tau = self._measured(measurement, B, q)
        dynamics = self.law(state.dynamics, both[0], s, both[1], tau, dt)
        wanted = (both[0] @ dynamics.theta_hat.unsqueeze(-1)).squeeze(-1) - self.damping * s
        force = (damped_pseudo_inverse(B, self.pseudo_damping) @ wanted.unsqueeze(-1)).squeeze(-1)
        force = within(torch.where(torch.isfinite(force), force, 0.0), self.force_limit)
        return CompositeState(later, dynamics, rate), command._replace(force=force)

    def _measured(self, measurement: Measurement, B: Tensor, q: Tensor) -> Tensor:
        """B u (..., n) of the measured forces; not a number where there are none."""
        if measurement.forces is None:
            return torch.full_like(q, torch.nan)
        u = check_tensor("measurement.forces", measurement.forces, (B.shape[-1],))
        return (B @ u.unsqueeze(-1)).squeeze(-1)
