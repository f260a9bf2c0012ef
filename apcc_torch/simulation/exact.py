"""The proof's case of section V-A: the configuration is known, so the loop is the equation of Eqs. (13)-(15)."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from apcc_torch.control.adaptation import AdaptiveLaw
from apcc_torch.control.controller import APCCController
from apcc_torch.control.trajectory import Trajectory
from apcc_torch.errors import ConfigError
from apcc_torch.part import Part, hold_rows
from apcc_torch.simulation.kinematic import KinematicLog, blank_row, on_target, run_loop
from apcc_torch.simulation.progress import Progress, quiet


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
        return ExactState(on_target(self.controller, self.pi, self.trajectory), pi_hat)

    def blank(self) -> tuple[ExactState, Tensor]:
        """Arguments of the form that one row has: what a compiler needs to see."""
        q, pi_hat, zero = blank_row(self.controller, self.pi)
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
        k1 = self.slope(q, pi_hat, time)
        row = (self.trajectory(time).x_d.expand_as(x), x, q, q, k1[0], pi_hat, none, none, status)
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
    raise ConfigError("where q is known adaptation must be a law of Eq. (15), such as proof")


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
        >>> controller = APCCController.for_arm(arm, adaptation=NormalisedLawSettings())
        >>> target = SetPoint(torch.tensor([0.05, 0.0, -0.44]).double())
        >>> true, first = arm.rest_lengths(), 1.1 * arm.rest_lengths()
        >>> log = simulate_exact(controller, true, first, target, duration=0.2, rate=100.0)
        >>> log.q_true.shape, bool((log.x - log.x_d).norm(dim=-1).max() < 1e-3)
        (torch.Size([21, 6]), True)
    """
    pi, pi_hat = torch.broadcast_tensors(pi, pi_hat)
    loop = ExactLoop(controller, pi, trajectory, 1.0 / rate)
    return run_loop(loop, loop.start(pi_hat), round(duration * rate) + 1, progress, compile, checkpointed)
