"""What goes into and comes out of the controller: the same in simulation, in a replay and on the arm."""

from __future__ import annotations

from typing import NamedTuple

from torch import Tensor

from apcc_torch.control.length_bank import BankEvidence
from apcc_torch.control.residual_adaptation import Evidence
from apcc_torch.control.tasks import TaskTarget
from apcc_torch.estimation.feedback import Feedback
from apcc_torch.estimation.pose_filter import PoseFilterState
from apcc_torch.estimation.savitzky_golay import SavitzkyGolayState


class Measurement(NamedTuple):
    """One reading of the sensors.

    T: (..., k, 4, 4) sensor poses, world frame, m.
    time: (...) stamp, s.
    mask: (..., k) bool, False for a sensor to leave out; None for all.
    angular_mask: (..., k) bool, False for an orientation to leave out; None for `mask`.
    tip: (..., 3) measured end-effector position, m; None to take the last sensor's.
    forces: (..., n_a) tendon forces u at the stamp, N, tension is -u; None where they are not measured.
    """

    T: Tensor
    time: Tensor
    mask: Tensor | None = None
    angular_mask: Tensor | None = None
    tip: Tensor | None = None
    forces: Tensor | None = None


class Target(NamedTuple):
    """Where the end effector should be.

    x_d: (..., 3) desired position, world frame, m.
    xdot_d: (..., 3) desired velocity, m/s.
    tasks: What each further task of a `TaskController` should reach, in the order of its stack; None for none.
    """

    x_d: Tensor
    xdot_d: Tensor
    tasks: tuple[TaskTarget, ...] | None = None


class Command(NamedTuple):
    """What the controller asks for, and what it saw.

    qdot: (..., 3 n_b) configuration velocity, Eq. (16), rad/s and m/s.
    q_d: (..., 3 n_b) desired configuration, the integral of qdot.
    y: (..., n_a) tendon length changes B_hat^T q_d, Eq. (49), m; None without tendons.
    e: (..., 3) position error x_d - x, m.
    feedback: What algorithm 2 returned.
    limits: (...) `SolverStatus` of the velocity where tendon limits are in force; None elsewhere.
    force: (..., n_a) feed-forward of the tendon loop, N; None without a model of the dynamics.
    """

    qdot: Tensor
    q_d: Tensor
    y: Tensor | None
    e: Tensor
    feedback: Feedback
    limits: Tensor | None = None
    force: Tensor | None = None


class ControllerState(NamedTuple):
    """Everything the controller remembers between steps.

    q_bar: (..., 3 n_b) last inferred configuration.
    qdot_bar: (..., 3 n_b) its filtered velocity.
    pi_hat: (..., n_b) parameter estimates, m.
    q_d: (..., 3 n_b) desired configuration.
    qdot: (..., 3 n_b) last commanded velocity.
    velocity_filter: State of the Savitzky-Golay filter.
    time: (...) stamp of the last measurement, s.
    evidence: What a `ResidualLaw` with memory or a `LengthBank` remembers; None without one.
    expected: Where a `PoseFilter` expects the sensors; None without one.
    integral: (..., 3) z of a `TaskIntegral`, m; None without one.
    """

    q_bar: Tensor
    qdot_bar: Tensor
    pi_hat: Tensor
    q_d: Tensor
    qdot: Tensor
    velocity_filter: SavitzkyGolayState
    time: Tensor
    evidence: Evidence | BankEvidence | None = None
    expected: PoseFilterState | None = None
    integral: Tensor | None = None
