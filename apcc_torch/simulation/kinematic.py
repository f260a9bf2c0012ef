"""The kinematic simulation of section V-A: a true arm that follows qdot exactly, seen through its sensors."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from apcc_torch.control.controller import APCCController
from apcc_torch.control.signals import Measurement
from apcc_torch.errors import ValueRangeError
from apcc_torch.linalg import damped_pseudo_inverse
from apcc_torch.model.abscissae import decouple
from apcc_torch.model.backbone import PCCBackbone
from apcc_torch.simulation.progress import Progress, quiet
from apcc_torch.simulation.rows import Rows
from apcc_torch.simulation.trajectory import Trajectory


class KinematicLog(NamedTuple):
    """A run of section V-A, time first.

    time: (T,) s.
    x_d: (T, ..., 3) desired, and x: (T, ..., 3) true end-effector position, m.
    q_true: (T, ..., 3 n_b) true configuration.
    q_bar: (T, ..., 3 n_b) inferred configuration.
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
    backbone: PCCBackbone, L0: Tensor, x: Tensor, q: Tensor | None = None, iterations: int = 60
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
    """
    batch = torch.broadcast_shapes(L0.shape[:-1], x.shape[:-1])
    q = torch.zeros(*batch, backbone.n, dtype=L0.dtype, device=L0.device) if q is None else q
    for _ in range(iterations):
        tip, J = backbone.tip_and_jacobian(q, L0)
        step = (damped_pseudo_inverse(J, 1e-4) @ (x - tip).unsqueeze(-1)).squeeze(-1)
        q = q + step / (step.abs().amax(-1, keepdim=True) / 0.3).clamp(min=1.0)
    miss = (backbone.tip(q, L0) - x).norm(dim=-1)
    tolerance = max(1e-6, 100 * torch.finfo(L0.dtype).eps)
    if not bool((miss < tolerance).all()):
        raise ValueRangeError(f"the start position is out of reach: missed by {float(miss.max()):g} m")
    return q


def simulate_exact(
    controller: APCCController,
    pi: Tensor,
    pi_hat: Tensor,
    trajectory: Trajectory,
    duration: float,
    rate: float,
    progress: Progress = quiet,
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
    """
    backbone, ik, law = controller.backbone, controller.inverse_kinematics, controller.law
    pi, pi_hat = torch.broadcast_tensors(pi, pi_hat)
    dt = 1.0 / rate

    def slope(q: Tensor, estimate: Tensor, time: Tensor) -> tuple[Tensor, Tensor]:
        target = trajectory(time)
        e = target.x_d - backbone.tip(q, pi)
        qdot = ik(backbone.tip_jacobian(q, estimate), e, target.xdot_d.expand_as(e), q)
        if not controller.adaptive:
            return qdot, torch.zeros_like(estimate)
        return qdot, law.velocity(backbone.regressor(q, qdot)[0], e)

    start = torch.zeros((), dtype=pi.dtype, device=pi.device)
    q = start_configuration(backbone, pi, trajectory(start).x_d)
    steps = round(duration * rate) + 1
    log = Rows(steps)
    for k in progress(range(steps)):
        time = start + k * dt
        target = trajectory(time)
        none = torch.zeros_like(controller.feedback.abscissae.to(q)).expand(*q.shape[:-1], -1)
        status = torch.zeros(q.shape[:-1], dtype=torch.int64, device=q.device)
        x_d = target.x_d.expand(*q.shape[:-1], 3)
        log.add((time, x_d, backbone.tip(q, pi), q, q, pi_hat, none, none, status))
        k1 = slope(q, pi_hat, time)
        k2 = slope(q + 0.5 * dt * k1[0], pi_hat + 0.5 * dt * k1[1], time + 0.5 * dt)
        k3 = slope(q + 0.5 * dt * k2[0], pi_hat + 0.5 * dt * k2[1], time + 0.5 * dt)
        k4 = slope(q + dt * k3[0], pi_hat + dt * k3[1], time + dt)
        q, pi_hat = (
            v + dt / 6.0 * (a + 2.0 * b + 2.0 * c + d)
            for v, a, b, c, d in zip((q, pi_hat), k1, k2, k3, k4, strict=True)
        )
    return KinematicLog(*log.stacked())


def simulate_feedback(
    controller: APCCController,
    pi: Tensor,
    pi_hat: Tensor,
    trajectory: Trajectory,
    duration: float,
    rate: float,
    progress: Progress = quiet,
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
    """
    backbone = controller.backbone
    pi, pi_hat = torch.broadcast_tensors(pi, pi_hat)
    start = torch.zeros((), dtype=pi.dtype, device=pi.device)
    q = start_configuration(backbone, pi, trajectory(start).x_d)
    X_tilde, j = decouple(controller.feedback.abscissae.to(pi), pi)
    state = controller.initial_state(q, pi_hat)
    steps = round(duration * rate) + 1
    log = Rows(steps)
    for k in progress(range(steps)):
        time = start + k / rate
        target = trajectory(time)
        T = backbone.pose(q, pi, X_tilde, j)
        before = state.pi_hat
        state, command = controller(state, Measurement(T, time), target)
        feedback = command.feedback
        x = target.x_d - command.e
        errors = (feedback.angular_error, feedback.linear_error)
        log.add((time, target.x_d.expand_as(x), x, q, feedback.q_bar, before, *errors, feedback.status))
        q = q + command.qdot / rate
    return KinematicLog(*log.stacked())
