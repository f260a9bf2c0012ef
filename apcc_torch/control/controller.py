"""The A-PCC controller: estimate, adapt, solve, as one pure step (state, measurement, target) -> (state, command)."""

from __future__ import annotations

import torch
from torch import Tensor

from apcc_torch.control.adaptation import AdaptiveLaw
from apcc_torch.control.bounds import within
from apcc_torch.control.inverse_kinematics import InverseKinematics
from apcc_torch.control.length_bank import BankEvidence, LengthBank
from apcc_torch.control.residual_adaptation import Evidence, ResidualLaw
from apcc_torch.control.step_io import Command, ControllerState, Measurement, Target
from apcc_torch.control.task_integral import TaskIntegral
from apcc_torch.errors import ValueRangeError
from apcc_torch.estimation.feedback import Inference
from apcc_torch.estimation.pose_filter import PoseFilter, PoseFilterState
from apcc_torch.estimation.savitzky_golay import SavitzkyGolay
from apcc_torch.estimation.state_feedback import StateFeedback
from apcc_torch.model.kinematic_model import KinematicModel, Placed
from apcc_torch.model.tendons import TendonRouting
from apcc_torch.part import Part, check_settings, hold
from apcc_torch.settings import Setting, check_setting
from apcc_torch.shapes import batch_shape, check_same, check_tensor

VELOCITIES = ("measured", "commanded")


class APCCController(Part):
    """Adaptive inverse kinematic control with decoupled sensing and actuation. Figs. 6, 10 [Dalenberg].

    One step: algorithm 2 infers q_bar with pi_hat frozen; the Savitzky-Golay filter gives its velocity; the law updates
    pi_hat, Eq. (15); inverse kinematics gives qdot, Eq. (16); its integral q_d is mapped to tendon length changes
    B_hat(pi_hat)^T q_d, Eq. (49). With `adaptive=False` pi_hat stays what it is: the standard controller.

    The elapsed time is the difference of the measurements' stamps, so uneven or late measurements are integrated as
    what they are. Nothing is remembered outside the state.

    Args:
        backbone: The model.
        feedback: Algorithm 2.
        velocity_filter: Derivative of q_bar.
        inverse_kinematics: Eqs. (14), (16).
        law: Eq. (15).
        routing: Tendons; None for no tendon command.
        adaptive: Whether the law runs.
        velocity: qdot of the regressor: "measured", the filtered derivative of q_bar as in the paper, or "commanded",
            the controller's own last qdot, which has neither lag nor noise but trusts the arm to follow.
        bend_bound: Bound on every angle of q_d, rad, a number or (...) one a row; None for no bound.
        elongation_bound: Bound on every length of q_d, m, likewise; None for no bound.
        reference_damping: T in y = B_hat^T (q_d - T qdot_bar), s. It damps the arm's swinging, which K alone, acting
            through an integral, excites once it exceeds twice the damping rate of the slowest mode. 0 for Eq. (49).
        integration_limit: Longest step that is integrated, s: after a pause the controller goes on, it does not leap.
        residual_law: A law of the sensors' residuals, or a bank of models, added to `law`, whose bounds hold for both;
            None for none.
        pose_filter: Of the sensors' poses, before all that sees them but the tip's error; None for none.
        integral: Integral action beside K e of Eq. (14); None for none.

    Raises:
        ValueRangeError: A setting is out of range.
    """

    bend_bound: Setting | None
    elongation_bound: Setting | None

    def __init__(
        self,
        backbone: KinematicModel,
        feedback: StateFeedback,
        velocity_filter: SavitzkyGolay,
        inverse_kinematics: InverseKinematics,
        law: AdaptiveLaw,
        routing: TendonRouting | None = None,
        adaptive: bool = True,
        velocity: str = "measured",
        bend_bound: Setting | None = None,
        elongation_bound: Setting | None = None,
        reference_damping: float = 0.0,
        integration_limit: float = 0.1,
        residual_law: ResidualLaw | LengthBank | None = None,
        pose_filter: PoseFilter | None = None,
        integral: TaskIntegral | None = None,
    ) -> None:
        super().__init__()
        if velocity not in VELOCITIES:
            raise ValueRangeError(f"velocity must be one of {', '.join(VELOCITIES)}, got {velocity!r}")
        bounds = {"bend_bound": bend_bound, "elongation_bound": elongation_bound}
        check_settings(**bounds, integration_limit=integration_limit)
        self.backbone = backbone
        self.feedback = feedback
        self.velocity_filter = velocity_filter
        self.inverse_kinematics = inverse_kinematics
        self.law = law
        self.residual_law = residual_law
        self.pose_filter = pose_filter
        self.integral = integral
        self.routing = routing
        self.adaptive = adaptive
        self.velocity = velocity
        hold(self, **bounds)
        self.reference_damping = check_setting("reference_damping", reference_damping, zero=True)
        self.integration_limit = integration_limit

    def initial_state(self, q: Tensor, pi_hat: Tensor, time: Tensor | None = None) -> ControllerState:
        """State before the first measurement.

        Args:
            q: (..., n) first guess of the configuration, also the first q_d.
            pi_hat: (..., n_b) first estimates, m.
            time: (...) s; None for 0.

        Raises:
            ShapeError, DtypeError: The arguments do not fit each other.
        """
        self.backbone.check(q, pi_hat)
        batch = torch.broadcast_shapes(q.shape[:-1], pi_hat.shape[:-1])
        q, pi_hat = q.expand(*batch, q.shape[-1]), pi_hat.expand(*batch, pi_hat.shape[-1])
        # Stamps keep their dtype: large ones need float64 even where the arm runs in float32.
        stamp = torch.zeros_like(q[..., 0]) if time is None else time.to(q.device).expand(batch)
        still = torch.zeros_like(q)
        evidence = None if self.residual_law is None else self.residual_law.initial_evidence(q, pi_hat)
        filtered = self.velocity_filter.initial_state(q, stamp)
        poses = self.pose_filter
        expected = None if poses is None else poses.initial_state(q, self.feedback.abscissae.shape[-1])
        integral = None if self.integral is None else still[..., :3]
        return ControllerState(q, still, pi_hat, q, still, filtered, stamp, evidence, expected, integral)

    def forward(
        self, state: ControllerState, measurement: Measurement, target: Target
    ) -> tuple[ControllerState, Command]:
        """One control step.

        Args:
            state: From `initial_state` or the last step.
            measurement: Sensor poses and their stamp.
            target: Desired position and velocity.

        Returns:
            The next state, and the command of this step.

        Raises:
            ShapeError, DtypeError: The arguments do not fit each other.
        """
        batch = self._check(state, measurement, target)
        pi_hat = state.pi_hat
        dt = (measurement.time - state.time).clamp(0.0, self.integration_limit).to(pi_hat.dtype)
        expected, T = self._filtered(state, measurement, dt)
        inference = self.feedback.infer(state.q_bar, pi_hat, T, measurement.mask, measurement.angular_mask)
        q_bar = inference.feedback.q_bar
        filtered, qdot_bar = self.velocity_filter(state.velocity_filter, q_bar, measurement.time)

        # One chain serves the tip, its Jacobian and that Jacobian's rate.
        sensitive = self.residual_law is not None and self.residual_law.needs_sensitivity
        if self.adaptive and (self.law.regressor == "estimator_aware" or sensitive):
            chain, followed = self.feedback.followed(inference, batch)
        else:
            chain, followed = self.backbone.chain(q_bar.expand(*batch, q_bar.shape[-1]), pi_hat), None
        x, tip_seen = self._measured_tip(measurement, chain.tip)
        e = target.x_d - x
        # Where the tip is not measured e is the model's own: it is not integrated, and teaches nothing of the model.
        e_seen = torch.where(tip_seen.unsqueeze(-1), e, 0.0)
        integral = state.integral
        if self.integral is not None and integral is not None:
            integral = self.integral(integral, e_seen, dt)
        wanted = e if integral is None else e + integral
        qdot, limits = self._solve(state, measurement, target, q_bar, chain, wanted, dt)
        q_d = self._bounded(state.q_d + dt.unsqueeze(-1) * qdot)
        # A step that is not finite is not taken: one bad measurement or target must not stay in the integral.
        q_d = torch.where(torch.isfinite(q_d), q_d, state.q_d)
        evidence = state.evidence
        if self.adaptive:
            Y = self._regressor_on(chain, followed, q_bar, qdot_bar if self.velocity == "measured" else qdot, batch)
            other = None
            if self.residual_law is not None:
                other, evidence = self._residual_velocity(inference, followed, T, dt.expand(batch), evidence)
            pi_hat = self.law(pi_hat, Y, e_seen, dt, other)
        y = self.tendons(q_d - self.reference_damping * qdot_bar, pi_hat)
        if self.pose_filter is not None and expected is not None:
            expected = self.pose_filter.moved(expected, self.backbone, inference.problem.points, q_bar, q_d - state.q_d)
        stamp = measurement.time.expand_as(dt)
        later = ControllerState(q_bar, qdot_bar, pi_hat, q_d, qdot, filtered, stamp, evidence, expected, integral)
        return later, Command(qdot, q_d, y, e, inference.feedback, limits)

    def _filtered(
        self, state: ControllerState, measurement: Measurement, dt: Tensor
    ) -> tuple[PoseFilterState | None, Tensor]:
        """The pose filter's state, and the poses (..., k, 4, 4) that algorithm 2 sees."""
        if self.pose_filter is None or state.expected is None:
            return None, measurement.T
        usable, oriented = self.feedback.used(measurement.T, measurement.mask, measurement.angular_mask)
        return self.pose_filter(state.expected, measurement.T, usable, oriented, dt)

    def _solve(
        self,
        state: ControllerState,
        measurement: Measurement,
        target: Target,
        q_bar: Tensor,
        chain: Placed,
        e: Tensor,
        dt: Tensor,
    ) -> tuple[Tensor, Tensor | None]:
        """qdot (..., n) of Eq. (16), with the model's chain at (q_bar, pi_hat), and `Command.limits`."""
        return self.inverse_kinematics(chain.tip_jacobian(), e, target.xdot_d.expand_as(e), q_bar, dt), None

    def _regressor_on(
        self, chain: Placed, followed: Tensor | None, q_bar: Tensor, qdot: Tensor, batch: torch.Size
    ) -> Tensor:
        """The law's Y (..., 3, n_b) along qdot, on the chain of this step."""
        if self.law.regressor == "none":
            return torch.zeros(*batch, 3, self.backbone.n_sections, dtype=q_bar.dtype, device=q_bar.device)
        if self.law.regressor == "partial":
            return self.backbone.regressor(q_bar, qdot)[0]
        assert followed is not None
        return self._total_regressor(chain.jacobian_rate(qdot.expand(*batch, qdot.shape[-1])), followed)

    def _residual_velocity(
        self,
        inference: Inference,
        followed: Tensor | None,
        T: Tensor,
        dt: Tensor,
        evidence: Evidence | BankEvidence | None,
    ) -> tuple[Tensor, Evidence | BankEvidence | None]:
        """What the residual law adds to pi_hat_dot (..., n_b), m/s, and its evidence."""
        law, batch = self.residual_law, dt.shape
        assert law is not None
        feedback, pi_hat, problem = inference
        seen = problem.usable.all(-1)
        if law.needs_orientations:
            seen = seen & problem.oriented.all(-1)
        q_bar, pi_hat = (v.expand(*batch, v.shape[-1]) for v in (feedback.q_bar, pi_hat))
        return law(self.backbone, q_bar, pi_hat, followed, T, self.feedback.abscissae, dt, seen, evidence)

    def _check(self, state: ControllerState, measurement: Measurement, target: Target) -> torch.Size:
        """The leading shape of the step; raises where the arguments do not fit each other."""
        vectors = {"target.x_d": target.x_d, "target.xdot_d": target.xdot_d}
        if measurement.tip is not None:
            vectors["measurement.tip"] = measurement.tip
        for name, vector in vectors.items():
            check_tensor(name, vector, (3,))
        check_tensor("measurement.T", measurement.T, (self.feedback.abscissae.shape[-1], 4, 4))
        check_tensor("measurement.time", measurement.time, ())
        check_same(**{"state.q_bar": state.q_bar, "measurement.T": measurement.T, **vectors})
        leading = {name: (vector, 1) for name, vector in vectors.items()}
        leading |= {"measurement.T": (measurement.T, 3), "measurement.time": (measurement.time, 0)}
        for name, mask in {"mask": measurement.mask, "angular_mask": measurement.angular_mask}.items():
            if mask is not None:
                leading[f"measurement.{name}"] = (mask, 1)
        return batch_shape(**{"state.q_bar": (state.q_bar, 1), "state.pi_hat": (state.pi_hat, 1), **leading})

    def regressor(
        self,
        q: Tensor,
        qdot: Tensor,
        pi_hat: Tensor,
        mask: Tensor | None = None,
        angular_mask: Tensor | None = None,
    ) -> Tensor:
        """The regressor (..., 3, n_b) that the law names: Y of Eq. (2), or the total derivative; see `AdaptiveLaw`."""
        if self.law.regressor == "partial":
            return self.backbone.regressor(q, qdot)[0]
        followed = self.feedback.sensitivity(q, pi_hat, mask, angular_mask)
        return self._total_regressor(self.backbone.tip_jacobian_rate(q, qdot, pi_hat), followed)

    def _measured_tip(self, measurement: Measurement, x_hat: Tensor) -> tuple[Tensor, Tensor]:
        """The end effector and whether it was measured; the model's where the measurement is masked or not finite."""
        if measurement.tip is not None:
            x, seen = measurement.tip, torch.isfinite(measurement.tip).all(-1)
        else:
            x = measurement.T[..., -1, :3, 3]
            seen = torch.isfinite(x).all(-1)
            if measurement.mask is not None:
                seen = seen & measurement.mask[..., -1]
        return torch.where(seen.unsqueeze(-1), x, x_hat), seen

    def tendons(self, q: Tensor, pi_hat: Tensor) -> Tensor | None:
        """Tendon length changes (..., n_a), m, that a configuration q (..., n) means; None without a routing."""
        return None if self.routing is None else self.backbone.tendon_lengths(self.routing, q, pi_hat)

    def _bounded(self, q_d: Tensor) -> Tensor:
        if self.bend_bound is None and self.elongation_bound is None:
            return q_d
        coordinates = self.backbone.coordinates
        bounds = {"rad": self.bend_bound, "m": self.elongation_bound}
        entries = zip(coordinates.of_pattern(q_d).unbind(-1), coordinates.pattern, strict=True)
        return torch.stack([within(entry, bounds[c.unit]) for entry, c in entries], dim=-1).flatten(-2)

    def _total_regressor(self, rate: Tensor, followed: Tensor) -> Tensor:
        """Y + d(J qdot)/dq dq_bar/dpi (..., 3, n_b) from Jdot (..., 3, n), whose columns of delta L are Y, Eq. (8)."""
        return rate[..., self.backbone.coordinates.elongations] + rate @ followed
