"""The kinematic simulation of section V-A: a true arm that follows qdot exactly, seen through its sensors."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import torch
from torch import Tensor

from apcc_torch.control.controller import APCCController
from apcc_torch.control.step_io import ControllerState, Measurement
from apcc_torch.control.trajectory import Trajectory
from apcc_torch.errors import ValueRangeError
from apcc_torch.linalg import damped_pseudo_inverse, scaled_within
from apcc_torch.model.abscissae import decouple
from apcc_torch.model.curvature import curvature_weights, middle_curvature
from apcc_torch.model.kinematic_model import KinematicModel
from apcc_torch.modes import holds
from apcc_torch.native.compiled import compiled
from apcc_torch.part import Part, hold_rows, refuse_parameter, untrained
from apcc_torch.shapes import broadcast
from apcc_torch.simulation.progress import Progress, quiet
from apcc_torch.simulation.rollout import rollout
from apcc_torch.simulation.sensors import Draws, PoseSensors, SensorState


class KinematicLog(NamedTuple):
    """A run of section V-A, time first.

    time: (T,) s.
    x_d: (T, ..., 3) desired, and x: (T, ..., 3) true end-effector position, m.
    q_true: (T, ..., n) true configuration.
    q_bar: (T, ..., n) inferred configuration, and qdot_bar: (T, ..., n) its filtered velocity.
    pi_hat: (T, ..., n_b) estimates, m.
    angular_error: (T, ..., k) rad, and linear_error: (T, ..., k) m, of algorithm 2.
    status: (T, ...) `FeedbackStatus`.
    """

    time: Tensor
    x_d: Tensor
    x: Tensor
    q_true: Tensor
    q_bar: Tensor
    qdot_bar: Tensor
    pi_hat: Tensor
    angular_error: Tensor
    linear_error: Tensor
    status: Tensor


def start_configuration(backbone: KinematicModel, L0: Tensor, x: Tensor, iterations: int = 60) -> Tensor:
    """A configuration (..., n) whose tip is at x, by damped Newton steps from the straight arm.

    Args:
        backbone: The arm.
        L0: (..., n_b) m.
        x: (..., 3) m.
        iterations: Steps.

    Raises:
        ValueRangeError: Some x is not reached to 1 micrometre.

    Example:
        >>> backbone, L0 = PCCBackbone(2), torch.tensor([0.2, 0.25]).double()
        >>> q = start_configuration(backbone, L0, torch.tensor([0.1, 0.05, 0.4]).double())
        >>> backbone.tip(q, L0)
        tensor([0.1000, 0.0500, 0.4000], dtype=torch.float64)
    """
    batch = broadcast(L0.shape[:-1], x.shape[:-1])
    q = torch.zeros(*batch, backbone.n, dtype=L0.dtype, device=L0.device)
    for _ in range(iterations):
        tip, J = backbone.tip_and_jacobian(q, L0)
        step = (damped_pseudo_inverse(J, 1e-4) @ (x - tip).unsqueeze(-1)).squeeze(-1)
        q = q + scaled_within(step, 0.3)
    miss = (backbone.tip(q, L0) - x).norm(dim=-1)
    tolerance = max(1e-6, 100 * torch.finfo(L0.dtype).eps)
    if not holds(miss < tolerance):
        raise ValueRangeError(f"the start position is out of reach: missed by {float(miss.max()):g} m")
    return q


class FeedbackState(NamedTuple):
    """The true arm's q (..., n), and what controller and sensors remember."""

    q: Tensor
    controller: ControllerState
    sensors: SensorState


class FeedbackLoop(Part):
    """One period of section V-A: sensors on the true arm, algorithm 2 and the law; qdot is followed for one period.

    Args:
        controller: The controller, its feedback at the arm's sensors.
        pi: (..., n_b) true rest lengths, m.
        trajectory: What to follow.
        dt: Period, s.
        sensors: What the sensors make of the true poses; None for perfect ones.
        curvature_places: (..., n_c) abscissae where curvature is measured, m; None for nowhere.
    """

    pi: Tensor
    X_tilde: Tensor
    j: Tensor
    curvature_weights: Tensor | None

    def __init__(
        self,
        controller: APCCController,
        pi: Tensor,
        trajectory: Trajectory,
        dt: float,
        sensors: PoseSensors | None = None,
        curvature_places: Tensor | None = None,
    ) -> None:
        super().__init__()
        self.controller = controller
        self.trajectory = trajectory
        self.dt = dt
        self.sensors = PoseSensors() if sensors is None else sensors
        refuse_parameter("pi", pi, "where the sensors are is made of it once; hand in a plain tensor")
        X_tilde, j = decouple(untrained(controller.feedback.abscissae).to(pi), pi)
        weights = None if curvature_places is None else curvature_weights(pi, 1, curvature_places.to(pi))
        hold_rows(self, pi=(pi, 1), X_tilde=(X_tilde, 1), j=(j, 1), curvature_weights=(weights, 2))

    def poses(self, q: Tensor) -> Tensor:
        """True poses of the sensors (..., k, 4, 4)."""
        return self.controller.backbone.pose(q, self.pi, self.X_tilde, self.j)

    def curvature(self, q: Tensor) -> Tensor | None:
        """True curvature (..., n_c, 2) where it is measured, 1/m; None where it is not."""
        if self.curvature_weights is None:
            return None
        return self.curvature_weights @ middle_curvature(self.controller.backbone, q, self.pi)

    def start(self, pi_hat: Tensor, generator: torch.Generator | None = None) -> FeedbackState:
        """On the trajectory's first point; pi_hat (..., n_b) m, generator of what is drawn once of the sensors."""
        q = on_target(self.controller, self.pi, self.trajectory)
        state = self.controller.initial_state(q, pi_hat)
        return FeedbackState(q, state, self.sensors.initial_state(self.poses(q), self.curvature(q), generator))

    def blank(self) -> tuple[FeedbackState, Tensor, Draws]:
        """Arguments of the form that one row has: what a compiler needs to see."""
        q, pi_hat, zero = blank_row(self.controller, self.pi)
        T = torch.eye(4, dtype=q.dtype, device=q.device).expand(self.j.shape[-1], 4, 4)
        chance = torch.Generator(T.device)
        sensors = self.sensors.initial_state(T, self.curvature(q), chance)
        now = FeedbackState(q, self.controller.initial_state(q, pi_hat), sensors)
        return now, zero, self.draw(T[(None,) * self.sensors.shared], chance)

    def draw(self, T: Tensor, generator: torch.Generator | None) -> Draws:
        """The chance in one reading; see `PoseSensors.draw`."""
        n_curvature = 0 if self.curvature_weights is None else self.curvature_weights.shape[-2]
        return self.sensors.draw(T, generator, n_curvature=n_curvature)

    def forward(self, now: FeedbackState, time: Tensor, draws: Draws) -> tuple[FeedbackState, tuple[Tensor, ...]]:
        """The state one period later, and the row of the log: `KinematicLog`'s fields without the time.

        Args:
            now: The loop.
            time: () s.
            draws: The chance in the sensors' reading.
        """
        target, ahead = self.trajectory(time), self.trajectory(time + self.dt)
        # qdot is held for a period, so it carries the target's mean velocity over that period.
        target = target._replace(xdot_d=(ahead.x_d - target.x_d) / self.dt)
        sensors, seen = self.sensors.sense(now.sensors, self.poses(now.q), self.curvature(now.q), draws)
        measurement = Measurement(seen.T, time, seen.mask, curvature=seen.curvature)
        state, command = self.controller(now.controller, measurement, target)
        feedback = command.feedback
        x = self.controller.backbone.tip(now.q, self.pi)
        q_bar, pi_hat = feedback.q_bar, now.controller.pi_hat
        errors = (feedback.angular_error, feedback.linear_error)
        row = (target.x_d.expand_as(x), x, now.q, q_bar, state.qdot_bar, pi_hat, *errors, feedback.status)
        return FeedbackState(now.q + command.qdot * self.dt, state, sensors), row


def blank_row(controller: APCCController, like: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """q, pi_hat and a time of one row."""
    zero = torch.zeros((), dtype=like.dtype, device=like.device)
    return zero.expand(controller.backbone.n), zero.expand(controller.backbone.n_sections) + 0.1, zero


def on_target(controller: APCCController, pi: Tensor, trajectory: Trajectory) -> Tensor:
    """A configuration of the true arm on the trajectory's first point."""
    start = torch.zeros((), dtype=pi.dtype, device=pi.device)
    return start_configuration(controller.backbone, pi, trajectory(start).x_d)


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
    sensors: PoseSensors | None = None,
    generator: torch.Generator | None = None,
    curvature_places: Tensor | None = None,
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
        sensors: What the sensors make of the true poses; None for perfect ones.
        generator: Source of the sensors' noise; None for torch's global one.
        curvature_places: (..., n_c) abscissae where curvature is measured, m; None for nowhere.

    Example:
        >>> arm = Arm(lengths=[0.2, 0.25])
        >>> controller = APCCController.for_arm(arm, adaptation=NormalisedLawSettings())
        >>> target = SetPoint(torch.tensor([0.05, 0.0, -0.44]).double())
        >>> true, first = arm.rest_lengths(), 1.1 * arm.rest_lengths()
        >>> log = simulate_feedback(controller, true, first, target, duration=1.0, rate=50.0)
        >>> log.pi_hat.shape, bool((log.x - log.x_d)[-1].norm() < 1e-3)
        (torch.Size([51, 2]), True)
    """
    pi, pi_hat = torch.broadcast_tensors(pi, pi_hat)
    loop = FeedbackLoop(controller, pi, trajectory, 1.0 / rate, sensors, curvature_places)
    start = loop.start(pi_hat, generator)
    poses = start.sensors.queue[..., 0, :, :, :]

    def draws() -> tuple[Draws]:
        return (loop.draw(poses, generator),)

    return run_loop(loop, start, round(duration * rate) + 1, progress, compile, checkpointed, draws)


def run_loop(
    loop: Any,
    now: Any,
    steps: int,
    progress: Progress,
    compile: str,
    checkpointed: bool,
    further: Callable[[], tuple[Any, ...]] = tuple,
) -> KinematicLog:
    """All steps of an `ExactLoop` or a `FeedbackLoop` from a state.

    Args:
        loop: The loop.
        now: Its state.
        steps: How many.
        progress, compile, checkpointed: See `simulate_feedback`.
        further: Makes what a step is given besides the state and the time.
    """
    _, zero, *_ = example = loop.blank()
    step = compiled(loop, example, compile, now.q.shape[:-1].numel())

    def period(now: Any, *given: Any) -> tuple[Any, tuple[Tensor, ...]]:
        now, row = step(now, *given)
        return now, (given[0], *row)

    def arguments(k: int) -> tuple[Any, ...]:
        return zero + k * loop.dt, *further()

    _, fields = rollout(period, now, arguments, steps, checkpointed, progress)
    return KinematicLog(*fields)
