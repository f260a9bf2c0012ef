"""A controller with a model of the dynamics around the kinematic one: a feed-forward force beside the tendon lengths.

The kinematic controller adapts the rest lengths, the law of the dynamics what the arm weighs and how stiff it is; with
both it is the composite controller that the paper leaves to further work.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import torch
from torch import Tensor

from apcc_torch.control.adaptive_dynamics import AdaptiveDynamics, AdaptiveDynamicsSettings, DynamicsEstimate
from apcc_torch.control.bounds import within
from apcc_torch.control.controller import APCCController
from apcc_torch.control.step_io import Command, ControllerState, Measurement, Target, elapsed
from apcc_torch.errors import ConfigError
from apcc_torch.estimation.state_feedback import StateFeedback
from apcc_torch.linalg import damped_pseudo_inverse
from apcc_torch.model.backbone import PCCBackbone
from apcc_torch.model.dynamics_regressor import PARAMETERS, DynamicsRegressor
from apcc_torch.model.kinematic_model import KinematicModel
from apcc_torch.model.tendons import TendonRouting
from apcc_torch.part import Part
from apcc_torch.settings import OURS, PAPER, names, resolved, setting
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


@dataclass(frozen=True, kw_only=True)
class CompositeControllerSettings(AdaptiveDynamicsSettings):
    """Settings of `CompositeController`, with what is believed of the arm's dynamics and how its law learns them."""

    adapts: bool = setting(True, "", OURS, "false: the feed-forward keeps what is believed")
    bending_rigidity: float = setting(0.0778, "N m^2", PAPER, "E I believed: 0.778 N m/rad of 0.1 m", least=0)
    axial_rigidity: float = setting(10.0, "N", PAPER, "E A believed: 100 N/m of 0.1 m", least=0)
    tendon_damping: float = setting(200.0, "N s/m", OURS, "viscous friction of each tendon believed", least=0)
    payload: float = setting(0.0, "kg", OURS, "at the tip believed", least=0)
    mass: float = setting(1.0, "kg", PAPER, "of the arm believed", least=0)
    bending_rigidity_deviation: float = setting(0.02, "N m^2", OURS, "how uncertain it is; 0: known", least=0)
    axial_rigidity_deviation: float = setting(3.0, "N", OURS, "likewise", least=0)
    tendon_damping_deviation: float = setting(50.0, "N s/m", OURS, "likewise", least=0)
    payload_deviation: float = setting(0.3, "kg", OURS, "likewise", least=0)
    mass_deviation: float = setting(0.0, "kg", OURS, "likewise", least=0)
    lower: tuple[float, ...] | None = setting(
        None, "", OURS, "five smallest values, in this order; null: zero, a tenth of the rigidities believed"
    )
    upper: tuple[float, ...] | None = setting(None, "", OURS, "five largest values; null: none")
    damping_ratio: float = setting(0.1, "s", PAPER, "D = damping_ratio K: known", least=0)
    stiffness: float = setting(3.0, "1/s", OURS, "Lambda of the reference velocity", least=0)
    damping: float = setting(
        0.0, "N m s/rad", OURS, "K_s on the bends and, over 1 m^2, on the elongations, beside the tendons' PID", least=0
    )
    reference_time: float = setting(0.1, "s", OURS, "low-pass on the rate of q_d", above=0)
    force_limit: float | None = setting(None, "N", OURS, "bound on each tendon's feed-forward; null: none", above=0)
    pseudo_damping: float = setting(
        1e-3, "m/rad", OURS, "of the pseudo-inverse of B_hat, in the units of B", above=0, key=False
    )


class CompositeController(Part):
    """`APCCController` with a feed-forward u = B_hat(pi_hat)^+ (Y_d theta_hat - K_s s), added to the tendon loop.

    The references of Y_d come from q_d: its rate behind a low-pass, v, with that filter's own acceleration, both with
    Lambda (q_bar - q_d) taken off, so that s = qdot_bar - v + Lambda (q_bar - q_d). Gravity is taken where the arm is,
    elasticity at q_d: the arm's own stiffness then helps to hold it there, and no noise is fed back through it.

    The measurement's `forces` are the tendon forces at its stamp; without them only s adapts.

    Args:
        kinematic: Gives q_bar, qdot_bar, pi_hat, q_d. With a routing and a model of constant-curvature sections.
        regressor: Y_d; None for that of the controller's tendons.
        law: theta_hat; None for that of the settings.
        *settings, **changes: See `CompositeControllerSettings`.

    Raises:
        ConfigError: The controller has no routing, or the model is none of constant-curvature sections.
        ValueRangeError: A setting is out of range.

    Example:
        >>> kinematic = APCCController.for_arm(Arm(lengths=[0.2, 0.25]), adaptation=None)
        >>> controller = CompositeController(kinematic, payload=0.1)
        >>> controller.law.nominal
        tensor([7.7800e-02, 1.0000e+01, 2.0000e+02, 1.0000e-01, 1.0000e+00],
               dtype=torch.float64)
    """

    settings_type = CompositeControllerSettings
    stiffness: float
    damping: float
    reference_time: float
    pseudo_damping: float
    force_limit: float | None

    def __init__(
        self,
        kinematic: APCCController,
        regressor: DynamicsRegressor | None = None,
        law: AdaptiveDynamics | None = None,
        *settings: Any,
        **changes: Any,
    ) -> None:
        super().__init__()
        s = resolved(type(self).settings_type, settings, changes)
        if kinematic.routing is None:
            raise ConfigError("a controller with a model of the dynamics needs a tendon routing")
        if kinematic.pressure is not None:
            raise ConfigError("a feed-forward of the tendon loop needs tendons: arm.chambers have a model of their own")
        if kinematic.shape is not None:
            raise ConfigError("a feed-forward of the dynamics needs q_bar of algorithm 2, not adaptation=shape")
        if not isinstance(kinematic.backbone, PCCBackbone):
            raise ConfigError("a feed-forward of the dynamics needs a model of constant-curvature sections, model=pcc")
        self.kinematic = kinematic
        base = kinematic.backbone.base_rotation
        self.dynamics = DynamicsRegressor(kinematic.routing, base, s.damping_ratio) if regressor is None else regressor
        with base.device:  # where numbers become tensors
            self.law = _law(s) if law is None else law
        self.hold(s)

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
        dt = elapsed(before.time, later.time, self.kinematic.integration_limit, q)
        passed, step = (dt > 0).unsqueeze(-1), dt.clamp(min=1e-9).unsqueeze(-1)
        share = 1.0 - torch.exp(-dt / self.reference_time).unsqueeze(-1)
        rate = torch.lerp(state.rate, torch.where(passed, (q_d - before.q_d) / step, 0.0), share)
        off = q - q_d
        v = rate - self.stiffness * off
        a = torch.where(passed, (rate - state.rate) / step, 0.0) - self.stiffness * (qdot - rate)
        s = qdot - v
        # Behind the law's low-pass a difference is what it was integrated from: no rate of q_bar has to be right.
        moved = torch.where(passed, (q - before.q_bar) / step, 0.0)
        swung = torch.where(passed, (qdot - before.qdot_bar) / step, 0.0)
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


def _law(s: CompositeControllerSettings) -> AdaptiveDynamics:
    """The law of theta; of a feed-forward one that moves nothing."""

    def row(values: Sequence[float]) -> Tensor:
        return torch.tensor([float(value) for value in values], dtype=torch.float64)

    deviation = row([getattr(s, f"{name}_deviation") if s.adapts else 0.0 for name in PARAMETERS])
    bounds = {}
    for name, values in {"lower": s.lower, "upper": s.upper}.items():
        if values is not None and len(values) != len(PARAMETERS):
            raise ConfigError(f"{name} must have {len(PARAMETERS)} entries, got {len(values)}")
        bounds[name] = None if values is None else row(values)
    learning = {} if s.adapts else {"tracking_gain": 0.0, "prediction": False}
    return AdaptiveDynamics(row([getattr(s, name) for name in PARAMETERS]), deviation, **bounds, **_own(s) | learning)


def _own(s: CompositeControllerSettings) -> dict[str, Any]:
    return {name: getattr(s, name) for name in names(AdaptiveDynamicsSettings)}
