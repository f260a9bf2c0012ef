"""The A-PCC controller: estimate, adapt, solve, as one pure step (state, measurement, target) -> (state, command)."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Self

import torch
from torch import Tensor, nn

from apcc_torch.control.adaptation import total_regressor
from apcc_torch.control.asked import Asked
from apcc_torch.control.bounds import ReferenceBounds
from apcc_torch.control.control_settings import ControllerSettings, ControlSettings
from apcc_torch.control.inverse_kinematics import InverseKinematics
from apcc_torch.control.length_bounds import LengthBounds
from apcc_torch.control.length_law import LawStep, LengthLaw, adapted
from apcc_torch.control.pressure import PressureControl
from apcc_torch.control.reference import moved
from apcc_torch.control.step_io import Command, ControllerState, Measurement, Target, check_step, elapsed, measured_tip
from apcc_torch.control.task_integral import TaskIntegral
from apcc_torch.errors import ConfigError
from apcc_torch.estimation.feedback import FeedbackStatus, Inference
from apcc_torch.estimation.pose_filter import PoseFilter, PoseFilterState
from apcc_torch.estimation.savitzky_golay import SavitzkyGolay
from apcc_torch.estimation.shape_feedback import FollowedShape, ShapeFeedback
from apcc_torch.estimation.state_feedback import StateFeedback
from apcc_torch.model.arm import Arm
from apcc_torch.model.kinematic_model import KinematicModel, Placed
from apcc_torch.model.tendons import TendonRouting
from apcc_torch.part import Part, part_of
from apcc_torch.settings import Setting, resolved
from apcc_torch.shapes import broadcast


class APCCController(Part):
    """Adaptive inverse kinematic control with decoupled sensing and actuation. Figs. 6, 10 [Dalenberg].

    One step: algorithm 2 infers q_bar with pi_hat frozen; the Savitzky-Golay filter gives its velocity; the laws update
    pi_hat, Eq. (15); inverse kinematics gives qdot, Eq. (16); its integral q_d is mapped to tendon length changes
    B_hat(pi_hat)^T q_d, Eq. (49). With `adaptive=False` pi_hat stays what it is: the standard controller.

    The elapsed time is the difference of the measurements' stamps, so uneven or late measurements are integrated as
    what they are. Nothing is remembered outside the state. `reference_damping` damps what K alone excites, acting
    through an integral, once it exceeds twice the damping rate of the arm's slowest mode.

    Args:
        backbone: The model.
        feedback: Algorithm 2.
        velocity_filter: Derivative of q_bar.
        inverse_kinematics: Eqs. (14), (16).
        laws: Of the rest lengths, one or several, whose speeds add up; () for none.
        *settings, **changes: See `ControllerSettings`.
        bounds: Of pi_hat, whatever the laws say; None for none.
        routing: Tendons; None for no tendon command.
        pose_filter: Of the sensors' poses, before all that sees them but the tip's error; None for none.
        integral: Integral action beside K e of Eq. (14); None for none.
        shape: Of q_bar where the controller is adaptive; None for algorithm 2.
        pressure: From lengths to the pressures of chambers; None for tendons.

    Raises:
        ConfigError, ValueRangeError: A setting is wrong or out of range.

    Example:
        >>> controller = APCCController.for_arm(Arm(lengths=[0.2, 0.25]), K=1.5)
        >>> state = controller.initial_state(torch.zeros(6).double(), torch.tensor([0.2, 0.25]).double())
        >>> state.pi_hat
        tensor([0.2000, 0.2500], dtype=torch.float64)
    """

    settings_type = ControllerSettings
    adaptive: bool
    velocity: str
    bend_bound: Setting | None
    elongation_bound: Setting | None
    reference_damping: float
    integration_limit: float
    # As a list of laws is held by torch.
    laws: Sequence[LengthLaw]

    def __init__(
        self,
        backbone: KinematicModel,
        feedback: StateFeedback,
        velocity_filter: SavitzkyGolay,
        inverse_kinematics: InverseKinematics,
        laws: LengthLaw | Sequence[LengthLaw] = (),
        *settings: Any,
        bounds: LengthBounds | None = None,
        routing: TendonRouting | None = None,
        pose_filter: PoseFilter | None = None,
        integral: TaskIntegral | None = None,
        shape: ShapeFeedback | None = None,
        pressure: PressureControl | None = None,
        **changes: Any,
    ) -> None:
        super().__init__()
        s = resolved(ControllerSettings, settings, changes)
        self.backbone = backbone
        self.feedback = feedback
        self.velocity_filter = velocity_filter
        self.inverse_kinematics = inverse_kinematics
        self.laws = nn.ModuleList([laws] if isinstance(laws, LengthLaw) else laws)  # type: ignore[assignment]
        self.bounds = bounds
        self.pose_filter = pose_filter
        self.integral = integral
        self.shape, self.pressure = (shape if s.adaptive else None), pressure
        if self.shape is not None and any(law.needs_sensitivity for law in self.laws):
            raise ConfigError("a law along the derivative of algorithm 2's q_bar cannot run beside a law of the shape")
        if self.shape is None and feedback.kinds is not None:
            feedback.kinds.check_placed()
        self.routing = routing
        self.hold(s)

    @classmethod
    def on(cls, arm: Arm, control: ControlSettings, nominal: Tensor | None = None, **parts: Any) -> Self:
        """The controller of an arm.

        Args:
            arm: As it is believed to be.
            control: What the controller is made of.
            nominal: (..., n_b) first estimates, m, to which laws may lean; None for the arm's rest lengths.
            **parts: Further arguments of the class.
        """
        lengths = arm.rest_lengths()
        nominal = lengths if nominal is None else nominal
        backbone = part_of(control.model).on(arm.n_sections, arm.base_rotation(), control.model)
        feedback = StateFeedback(backbone, arm.sensor_places(), control.feedback, kinds=arm.sensor_kinds())
        solver = InverseKinematics(control.controller, coordinates=backbone.coordinates, n_sections=backbone.n_sections)
        chosen = control.adaptation
        law = None if chosen is None else part_of(chosen).on(nominal, feedback, chosen)
        return cls(
            backbone,
            feedback,
            SavitzkyGolay(control.velocity_filter),
            solver,
            () if law is None else law,
            control.controller,
            # Clones, so that what is trained of the arm is trained as what it is, and the bounds stay.
            bounds=LengthBounds(lengths.clone(), feedback.abscissae.clone(), control.bounds),
            routing=arm.routing(),
            pose_filter=None if control.pose_filter is None else PoseFilter(control.pose_filter),
            integral=None if control.integral is None else TaskIntegral(control.integral),
            shape=None if law is None else law.shape_feedback(arm, backbone),
            pressure=PressureControl.on(arm, control.pressure),
            **parts,
        )

    @classmethod
    def for_arm(cls, arm: Arm, **changes: Any) -> Self:
        """The shipped controller of any arm, with changes by name; see `ControlSettings.with_keys`.

        Example:
            >>> controller = APCCController.for_arm(Arm(lengths=[0.2, 0.25]), mode="position", window=9, gamma=20.0)
            >>> controller.feedback.mode, controller.velocity_filter.window
            ('position', 9)
        """
        return cls.on(arm, ControlSettings().with_keys(changes))

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
        batch = broadcast(q.shape[:-1], pi_hat.shape[:-1])
        q, pi_hat = q.expand(*batch, q.shape[-1]), pi_hat.expand(*batch, pi_hat.shape[-1])
        # Stamps keep their dtype: large ones need float64 even where the arm runs in float32.
        stamp = torch.zeros_like(q[..., 0]) if time is None else time.to(q.device).expand(batch)
        still = torch.zeros_like(q)
        memories = tuple(law.initial_memory(q, pi_hat) for law in self.laws)
        filtered, poses = self.velocity_filter.initial_state(q, stamp), self.pose_filter
        expected = None if poses is None else poses.initial_state(q, self.feedback.abscissae.shape[-1])
        integral = None if self.integral is None else still[..., :3]
        shape, q_d = (None, q) if self.shape is None else self.shape.start(q, pi_hat)
        y = None if self.pressure is None else self.tendons(q_d, pi_hat)
        pressure = None if self.pressure is None or y is None else self.pressure.initial_state(y)
        first = q, still, pi_hat, q_d, still, filtered, stamp, memories
        return ControllerState(*first, expected, integral, shape, pressure)

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
        batch = check_step(state, measurement, target, self.feedback.abscissae.shape[-1], self.shape)
        pi_hat, memories = state.pi_hat, state.memories
        dt = elapsed(state.time, measurement.time, self.integration_limit, pi_hat)
        expected, T = self.filtered(state, measurement, dt)
        shape, inference = self._inferred(state, measurement, T, dt)
        q_bar, valid = inference.feedback.q_bar, inference.feedback.status != int(FeedbackStatus.INVALID)
        filtered, qdot_bar = self.velocity_filter(state.velocity_filter, q_bar, measurement.time)

        # One chain serves the tip, its Jacobian and that Jacobian's rate.
        if self.adaptive and any(law.needs_sensitivity for law in self.laws):
            chain, dq_dpi = self.feedback.chain_and_sensitivity(inference, batch)
        else:
            chain, dq_dpi = self.backbone.chain(q_bar.expand(*batch, q_bar.shape[-1]), pi_hat), None
        x, tip_seen = measured_tip(measurement, chain.tip, valid, self.feedback.kinds)
        e = target.x_d - x
        # Without a measured tip, a target or an estimate e is not integrated, and teaches nothing.
        e_seen = torch.where((tip_seen & valid & torch.isfinite(e).all(-1)).unsqueeze(-1), e, 0.0)
        integral = state.integral
        if self.integral is not None and integral is not None:
            integral = self.integral(integral, e_seen, dt)
        wanted = e if integral is None else e + integral
        if self.shape is not None and shape is not None:
            shape, wanted = self.shape.ahead(shape, x, wanted, target.xdot_d, dt)
        reference = ReferenceBounds.of(self.backbone.coordinates, self.bend_bound, self.elongation_bound)
        bounds = None if reference is None else reference.rates(state.q_d, dt)
        if self.pressure is not None and state.pressure is not None:
            bounds = self.pressure.bounds(state.pressure, self.backbone.coordinates, bounds)
        driven = self._driven(q_bar, pi_hat, chain, shape, batch)
        qdot, limits = self._solve(Asked(state, measurement, target, *driven, wanted, dt, bounds))
        qdot, q_d, limits = moved(state.q_d, qdot, dt, e, valid, reference, bounds, limits)
        if self.adaptive and self.laws:
            velocity = qdot_bar if self.velocity == "measured" else qdot
            seen = [value.expand(*batch, value.shape[-1]) for value in (q_bar, inference.pi_hat, velocity)]
            step = LawStep(
                self.backbone,
                inference,
                *(seen[0], seen[1], seen[2]),
                e=e_seen,
                dt=dt.expand(batch),
                T=T,
                abscissae=self.feedback.abscissae,
                chain=chain,
                dq_dpi=dq_dpi,
            )
            pi_hat, memories = adapted(self.laws, self.bounds, step, memories, valid)
        y, p, pressure = self.tendons(q_d - self.reference_damping * qdot_bar, pi_hat), None, state.pressure
        if self.pressure is not None and y is not None and pressure is not None:
            pressure, p = self.pressure(pressure, y, self.tendons(driven[0], state.pi_hat), dt)
        if self.pose_filter is not None and expected is not None:
            expected = self.pose_filter.moved(expected, self.backbone, inference.problem.points, q_bar, q_d - state.q_d)
        later = (q_bar, qdot_bar, pi_hat, q_d, qdot, filtered, measurement.time.expand_as(dt), memories, expected)
        return ControllerState(*later, integral, shape, pressure), Command(
            qdot, q_d, y, e, inference.feedback, limits, pressure=p
        )

    def _inferred(
        self, state: ControllerState, measurement: Measurement, T: Tensor, dt: Tensor
    ) -> tuple[FollowedShape | None, Inference]:
        """What is known of the shape, and q_bar with what the sensors say of it."""
        masks = measurement.mask, measurement.angular_mask
        if self.shape is None or state.shape is None:
            return None, self.feedback.infer(state.q_bar, state.pi_hat, T, *masks)
        told = T, *masks, self.known_lengths(state, measurement), dt, measurement.curvature
        return self.shape.infer(self.feedback, state.shape, state.q_bar, state.pi_hat, *told)

    def known_lengths(self, state: ControllerState, measurement: Measurement) -> Tensor | None:
        """Length changes (..., n_a) that tendons have, m, as measured or as they were told; None of chambers."""
        if measurement.tendons is None and self.pressure is None:
            return self.tendons(state.q_d, state.pi_hat)
        return measurement.tendons

    def filtered(
        self, state: ControllerState, measurement: Measurement, dt: Tensor
    ) -> tuple[PoseFilterState | None, Tensor]:
        """The pose filter's state, and the poses (..., k, 4, 4) that algorithm 2 sees."""
        if self.pose_filter is None or state.expected is None:
            return None, measurement.T
        usable, oriented = self.feedback.used(measurement.T, measurement.mask, measurement.angular_mask)
        return self.pose_filter(state.expected, measurement.T, usable, oriented, dt)

    def _driven(
        self, q_bar: Tensor, pi_hat: Tensor, chain: Placed, shape: FollowedShape | None, batch: torch.Size
    ) -> tuple[Tensor, Tensor, Placed]:
        """q (..., n), rest lengths and chain that the tendons drive: with a shape, the arm's own sections'.

        Tendons bend and stretch those evenly, whatever arcs follow the shape best; so their lengths say q exactly.
        """
        if self.shape is None or shape is None:
            return q_bar, pi_hat, chain
        q = self.shape.strain(shape).expand(*batch, q_bar.shape[-1])
        lengths = self.driven_lengths(pi_hat).expand(*batch, pi_hat.shape[-1])
        return q, lengths, self.backbone.chain(q, lengths)

    def driven_lengths(self, pi_hat: Tensor) -> Tensor:
        """The sections' lengths (..., n_b) m with which q_d is mapped to the tendons."""
        return pi_hat if self.shape is None else self.shape.driven_lengths(pi_hat)

    def _solve(self, asked: Asked) -> tuple[Tensor, Tensor | None]:
        """qdot (..., n) of Eq. (16) within its bounds, and the tendons' `Command.limits`."""
        J, xdot_d = asked.chain.tip_jacobian(), asked.target.xdot_d.expand_as(asked.e)
        return self.inverse_kinematics(J, asked.e, xdot_d, asked.q, asked.dt, asked.bounds), None

    def regressor(
        self,
        q: Tensor,
        qdot: Tensor,
        pi_hat: Tensor,
        mask: Tensor | None = None,
        angular_mask: Tensor | None = None,
        T: Tensor | None = None,
    ) -> Tensor:
        """The total derivative Y + d(J qdot)/dq dq_bar/dpi (..., 3, n_b); see `AdaptiveLaw` and `sensitivity`."""
        dq_dpi = self.feedback.sensitivity(q, pi_hat, mask, angular_mask, T)
        return total_regressor(self.backbone.coordinates, self.backbone.tip_jacobian_rate(q, qdot, pi_hat), dq_dpi)

    def tendons(self, q: Tensor, pi_hat: Tensor) -> Tensor | None:
        """Tendon length changes (..., n_a), m, that a configuration q (..., n) means; None without a routing."""
        lengths = self.driven_lengths(pi_hat)
        return None if self.routing is None else self.backbone.tendon_lengths(self.routing, q, lengths)
