"""The kinematic simulation of section V-A: a true arm that follows qdot exactly, seen through its sensors."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from apcc_torch.control.adaptation import AdaptiveLaw
from apcc_torch.control.bounds import scaled_within
from apcc_torch.control.controller import APCCController
from apcc_torch.control.step_io import ControllerState, Measurement
from apcc_torch.control.trajectory import Trajectory
from apcc_torch.errors import ConfigError, ValueRangeError
from apcc_torch.linalg import damped_pseudo_inverse
from apcc_torch.model.abscissae import decouple
from apcc_torch.model.kinematic_model import KinematicModel
from apcc_torch.modes import holds
from apcc_torch.native.compiled import compiled
from apcc_torch.part import Part, hold_rows, refuse_parameter, untrained
from apcc_torch.simulation.progress import Progress, quiet
from apcc_torch.simulation.rollout import rollout


class KinematicLog(NamedTuple):
    """A run of section V-A, time first.

    time: (T,) s.
    x_d: (T, ..., 3) desired, and x: (T, ..., 3) true end-effector position, m.
    q_true: (T, ..., n) true configuration.
    q_bar: (T, ..., n) inferred configuration.
    pi_hat: (T, ..., n_b) estimates, m.
    angular_error: (T, ..., k) rad, and linear_error: (T, ..., k) m, of algorithm 2.
    status: (T, ...) `FeedbackStatus`.
    """

    time: Tensor
    x_d: Tensor
    x: Tensor
    q_true: Tensor
    q_bar: Tensor
    pi_hat: Tensor
    angular_error: Tensor
    linear_error: Tensor
    status: Tensor


def start_configuration(
    backbone: KinematicModel, L0: Tensor, x: Tensor, q: Tensor | None = None, iterations: int = 60
) -> Tensor:
    """A configuration (..., n) whose tip is at x, by damped Newton steps from q (default: the straight arm).

    Args:
        backbone: The arm.
        L0: (..., n_b) m.
        x: (..., 3) m.
        q: (..., n) first guess.
        iterations: Steps.

    Raises:
        ValueRangeError: Some x is not reached to 1 micrometre.

    Example:
        >>> backbone, L0 = PCCBackbone(2), torch.tensor([0.2, 0.25]).double()
        >>> q = start_configuration(backbone, L0, torch.tensor([0.1, 0.05, 0.4]).double())
        >>> backbone.tip(q, L0)
        tensor([0.1000, 0.0500, 0.4000], dtype=torch.float64)
    """
    batch = torch.broadcast_shapes(L0.shape[:-1], x.shape[:-1])
    q = torch.zeros(*batch, backbone.n, dtype=L0.dtype, device=L0.device) if q is None else q
    for _ in range(iterations):
        tip, J = backbone.tip_and_jacobian(q, L0)
        step = (damped_pseudo_inverse(J, 1e-4) @ (x - tip).unsqueeze(-1)).squeeze(-1)
        q = q + scaled_within(step, 0.3)
    miss = (backbone.tip(q, L0) - x).norm(dim=-1)
    tolerance = max(1e-6, 100 * torch.finfo(L0.dtype).eps)
    if not holds(miss < tolerance):
        raise ValueRangeError(f"the start position is out of reach: missed by {float(miss.max()):g} m")
    return q


class ExactState(NamedTuple):
    """q (..., n) and pi_hat (..., n_b), m, of the proof's case."""

    q: Tensor
    pi_hat: Tensor


class ExactLoop(Part):
    """One RK4 step of Eqs. (13)-(15), q being known.

    Args:
        controller: Supplies the inverse kinematics and the law of Eq. (15); its estimator and filter are not used.
        pi: (..., n_b) true rest lengths, m.
        trajectory: What to follow.
        dt: Step, s.

    Raises:
        ConfigError: The controller has other laws.
    """

    pi: Tensor

    def __init__(self, controller: APCCController, pi: Tensor, trajectory: Trajectory, dt: float) -> None:
        super().__init__()
        self.controller = controller
        self.trajectory = trajectory
        self.dt = dt
        self.law = _law_of(controller)
        hold_rows(self, pi=(pi, 1))

    def start(self, pi_hat: Tensor) -> ExactState:
        """On the trajectory's first point; pi_hat (..., n_b) m."""
        return ExactState(_on_target(self.controller, self.pi, self.trajectory), pi_hat)

    def blank(self) -> tuple[ExactState, Tensor]:
        """Arguments of the form that one row has: what a compiler needs to see."""
        q, pi_hat, zero = _blank(self.controller, self.pi)
        return ExactState(q, pi_hat), zero

    def slope(self, q: Tensor, pi_hat: Tensor, time: Tensor) -> tuple[Tensor, Tensor]:
        """qdot and pi_hat_dot at a time."""
        controller, backbone = self.controller, self.controller.backbone
        target = self.trajectory(time)
        e = target.x_d - backbone.tip(q, self.pi)
        J_hat = backbone.tip_jacobian(q, pi_hat)
        qdot = controller.inverse_kinematics(J_hat, e, target.xdot_d.expand_as(e), q)
        if self.law is None:
            return qdot, torch.zeros_like(pi_hat)
        return qdot, self.law.velocity(backbone.regressor(q, qdot)[0], e)

    def forward(self, now: ExactState, time: Tensor) -> tuple[ExactState, tuple[Tensor, ...]]:
        """The state one step later, and the row of the log: `KinematicLog`'s fields without the time."""
        q, pi_hat, dt = now.q, now.pi_hat, self.dt
        x = self.controller.backbone.tip(q, self.pi)
        none = torch.zeros_like(self.controller.feedback.abscissae.to(q)).expand(*q.shape[:-1], -1)
        status = torch.zeros_like(q[..., 0], dtype=torch.int64)
        row = (self.trajectory(time).x_d.expand_as(x), x, q, q, pi_hat, none, none, status)
        k1 = self.slope(q, pi_hat, time)
        k2 = self.slope(q + 0.5 * dt * k1[0], pi_hat + 0.5 * dt * k1[1], time + 0.5 * dt)
        k3 = self.slope(q + 0.5 * dt * k2[0], pi_hat + 0.5 * dt * k2[1], time + 0.5 * dt)
        k4 = self.slope(q + dt * k3[0], pi_hat + dt * k3[1], time + dt)
        later = (
            v + dt / 6.0 * (a + 2.0 * b + 2.0 * c + d)
            for v, a, b, c, d in zip((q, pi_hat), k1, k2, k3, k4, strict=True)
        )
        return ExactState(*later), row


def _law_of(controller: APCCController) -> AdaptiveLaw | None:
    """The law of Eq. (15); None for a controller that adapts nothing.

    Raises:
        ConfigError: It has other laws: they need sensors, and the proof's case has none.
    """
    if not controller.adaptive:
        return None
    laws = list(controller.laws)
    if len(laws) == 1 and isinstance(laws[0], AdaptiveLaw):
        return laws[0]
    raise ConfigError("where q is known the law is Eq. (15) alone: residual=none, and an adaptation of it")


class FeedbackState(NamedTuple):
    """The true arm's q (..., n), and what the controller remembers."""

    q: Tensor
    controller: ControllerState


class FeedbackLoop(Part):
    """One period of section V-A: sensors on the true arm, algorithm 2 and the law; qdot is followed for one period.

    Args:
        controller: The controller, its feedback at the arm's sensors.
        pi: (..., n_b) true rest lengths, m.
        trajectory: What to follow.
        dt: Period, s.
    """

    pi: Tensor
    X_tilde: Tensor
    j: Tensor

    def __init__(self, controller: APCCController, pi: Tensor, trajectory: Trajectory, dt: float) -> None:
        super().__init__()
        self.controller = controller
        self.trajectory = trajectory
        self.dt = dt
        refuse_parameter("pi", pi, "where the sensors are is made of it once; hand in a plain tensor")
        X_tilde, j = decouple(untrained(controller.feedback.abscissae).to(pi), pi)
        hold_rows(self, pi=(pi, 1), X_tilde=(X_tilde, 1), j=(j, 1))

    def start(self, pi_hat: Tensor) -> FeedbackState:
        """On the trajectory's first point; pi_hat (..., n_b) m."""
        q = _on_target(self.controller, self.pi, self.trajectory)
        return FeedbackState(q, self.controller.initial_state(q, pi_hat))

    def blank(self) -> tuple[FeedbackState, Tensor]:
        """Arguments of the form that one row has: what a compiler needs to see."""
        q, pi_hat, zero = _blank(self.controller, self.pi)
        return FeedbackState(q, self.controller.initial_state(q, pi_hat)), zero

    def forward(self, now: FeedbackState, time: Tensor) -> tuple[FeedbackState, tuple[Tensor, ...]]:
        """The state one period later, and the row of the log: `KinematicLog`'s fields without the time."""
        target = self.trajectory(time)
        T = self.controller.backbone.pose(now.q, self.pi, self.X_tilde, self.j)
        state, command = self.controller(now.controller, Measurement(T, time), target)
        feedback = command.feedback
        x = target.x_d - command.e
        errors = (feedback.angular_error, feedback.linear_error)
        row = (target.x_d.expand_as(x), x, now.q, feedback.q_bar, now.controller.pi_hat, *errors, feedback.status)
        return FeedbackState(now.q + command.qdot * self.dt, state), row


def _blank(controller: APCCController, like: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """q, pi_hat and a time of one row."""
    zero = torch.zeros((), dtype=like.dtype, device=like.device)
    return zero.expand(controller.backbone.n), zero.expand(controller.backbone.n_sections) + 0.1, zero


def _on_target(controller: APCCController, pi: Tensor, trajectory: Trajectory) -> Tensor:
    start = torch.zeros((), dtype=pi.dtype, device=pi.device)
    return start_configuration(controller.backbone, pi, trajectory(start).x_d)


def simulate_exact(
    controller: APCCController,
    pi: Tensor,
    pi_hat: Tensor,
    trajectory: Trajectory,
    duration: float,
    rate: float,
    progress: Progress = quiet,
    compile: str = "off",
    checkpointed: bool = False,
) -> KinematicLog:
    """The proof's case: q is known, so the loop is the differential equation of Eqs. (13)-(15); RK4 at `rate`.

    Args:
        controller: Supplies the inverse kinematics and the law; its estimator and filter are not used.
        pi: (..., n_b) true rest lengths, m.
        pi_hat: (..., n_b) first estimates, m.
        trajectory: What to follow.
        duration: s.
        rate: Steps a second, Hz.
        progress: Wraps the step counter, for a progress bar.
        compile: How a step is run, one of `native.compiled.MODES`; compiled code has no gradients.
        checkpointed: See `rollout`.

    Example:
        >>> arm = Arm(lengths=[0.2, 0.25])
        >>> controller = APCCController.for_arm(arm, residual=None)
        >>> target = SetPoint(torch.tensor([0.05, 0.0, -0.44]).double())
        >>> true, first = arm.rest_lengths(), 1.1 * arm.rest_lengths()
        >>> log = simulate_exact(controller, true, first, target, duration=0.2, rate=100.0)
        >>> log.q_true.shape, bool((log.x - log.x_d).norm(dim=-1).max() < 1e-3)
        (torch.Size([21, 6]), True)
    """
    pi, pi_hat = torch.broadcast_tensors(pi, pi_hat)
    loop = ExactLoop(controller, pi, trajectory, 1.0 / rate)
    return _run(loop, loop.start(pi_hat), loop.blank(), round(duration * rate) + 1, progress, compile, checkpointed)


def simulate_feedback(
    controller: APCCController,
    pi: Tensor,
    pi_hat: Tensor,
    trajectory: Trajectory,
    duration: float,
    rate: float,
    progress: Progress = quiet,
    compile: str = "off",
    checkpointed: bool = False,
) -> KinematicLog:
    """Section V-A whole: sensors on the true arm, algorithm 2 and the law in the loop. Fig. 6 [Dalenberg].

    The true arm holds each commanded qdot for one period.

    Args:
        controller: The controller, its feedback at the arm's sensors.
        pi: (..., n_b) true rest lengths, m.
        pi_hat: (..., n_b) first estimates, m.
        trajectory: What to follow.
        duration: s.
        rate: Control rate, Hz.
        progress: Wraps the step counter, for a progress bar.
        compile: How a step is run, one of `native.compiled.MODES`; compiled code has no gradients.
        checkpointed: See `rollout`.

    Example:
        >>> arm = Arm(lengths=[0.2, 0.25])
        >>> controller = APCCController.for_arm(arm, residual=None)
        >>> target = SetPoint(torch.tensor([0.05, 0.0, -0.44]).double())
        >>> true, first = arm.rest_lengths(), 1.1 * arm.rest_lengths()
        >>> log = simulate_feedback(controller, true, first, target, duration=1.0, rate=50.0)
        >>> log.pi_hat.shape, bool((log.x - log.x_d)[-1].norm() < 1e-3)
        (torch.Size([51, 2]), True)
    """
    pi, pi_hat = torch.broadcast_tensors(pi, pi_hat)
    loop = FeedbackLoop(controller, pi, trajectory, 1.0 / rate)
    return _run(loop, loop.start(pi_hat), loop.blank(), round(duration * rate) + 1, progress, compile, checkpointed)


def _run(
    loop: ExactLoop | FeedbackLoop,
    now: ExactState | FeedbackState,
    blank: tuple[ExactState | FeedbackState, Tensor],
    steps: int,
    progress: Progress,
    compile: str,
    checkpointed: bool,
) -> KinematicLog:
    """All steps of a loop from a state; `blank` is the form of one row."""
    step = compiled(loop, blank, compile, now.q.shape[:-1].numel())

    def period(now: ExactState | FeedbackState, time: Tensor) -> tuple[ExactState | FeedbackState, tuple[Tensor, ...]]:
        now, row = step(now, time)
        return now, (time, *row)

    _, fields = rollout(period, now, lambda k: (blank[1] + k * loop.dt,), steps, checkpointed, progress)
    return KinematicLog(*fields)
