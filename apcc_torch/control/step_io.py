"""What goes into and comes out of the controller: the same in simulation, in a replay and on the arm."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from apcc_torch.control.ahead import Ahead
from apcc_torch.control.length_law import Memory
from apcc_torch.control.pressure import PressureState
from apcc_torch.control.tasks import TaskTarget
from apcc_torch.estimation.feedback import Feedback
from apcc_torch.estimation.pose_filter import PoseFilterState
from apcc_torch.estimation.savitzky_golay import SavitzkyGolayState
from apcc_torch.estimation.shape_feedback import FollowedShape, ShapeFeedback
from apcc_torch.model.sensor_kinds import INERTIAL, SensorKinds
from apcc_torch.shapes import batch_shape, check_same, check_tensor


class Measurement(NamedTuple):
    """One reading of the sensors.

    T: (..., k, 4, 4) sensor poses, world frame, m; anything, such as NaN, for what a sensor does not measure.
    time: (...) stamp, s.
    mask: (..., k) bool, False for a sensor to leave out; None for all.
    angular_mask: (..., k) bool, False for an orientation to leave out; None for `mask`.
    tip: (..., 3) measured end-effector position, m; None to take the last sensor's.
    forces: (..., n_a) tendon forces u at the stamp, N, tension is -u; None where they are not measured.
    tendons: (..., n_a) tendon length changes at the stamp, m, NaN where one is not known; None to take those that the
        last command asked for, but of chambers, whose lengths are not known then.
    curvature: (..., n_c, 2) at the places of `Arm.curvature_sensors`, towards x and y of the axes there, 1/m, NaN where
        it is not known; None where nothing measures it.
    """

    T: Tensor
    time: Tensor
    mask: Tensor | None = None
    angular_mask: Tensor | None = None
    tip: Tensor | None = None
    forces: Tensor | None = None
    tendons: Tensor | None = None
    curvature: Tensor | None = None


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
    limits: (...) int64 `SolverStatus` of the velocity. LIMITED: a coordinate of q_d is held at its bound, or the
        tendons' limits matter. NOT_FINITE: the target is not, and the row holds its q_d.
    force: (..., n_a) feed-forward of the tendon loop, N; None without a model of the dynamics.
    pressure: (..., n_a) of the chambers, Pa; None of an arm without chambers.
    """

    qdot: Tensor
    q_d: Tensor
    y: Tensor | None
    e: Tensor
    feedback: Feedback
    limits: Tensor | None = None
    force: Tensor | None = None
    pressure: Tensor | None = None


class ControllerState(NamedTuple):
    """Everything the controller remembers between steps.

    q_bar: (..., 3 n_b) last inferred configuration.
    qdot_bar: (..., 3 n_b) its filtered velocity.
    pi_hat: (..., n_b) parameter estimates, m.
    q_d: (..., 3 n_b) desired configuration.
    qdot: (..., 3 n_b) last commanded velocity.
    velocity_filter: State of the Savitzky-Golay filter.
    time: (...) stamp of the last measurement, s.
    memories: What each law remembers, in their order.
    expected: Where a `PoseFilter` expects the sensors; None without one.
    integral: (..., 3) z of a `TaskIntegral`, m; None without one.
    shape: What a `ShapeFeedback` knows; None without one.
    pressure: What a `PressureControl` remembers; None without one.
    ahead: What a `LookaheadController` remembers; None of another.
    """

    q_bar: Tensor
    qdot_bar: Tensor
    pi_hat: Tensor
    q_d: Tensor
    qdot: Tensor
    velocity_filter: SavitzkyGolayState
    time: Tensor
    memories: tuple[Memory, ...] = ()
    expected: PoseFilterState | None = None
    integral: Tensor | None = None
    shape: FollowedShape | None = None
    pressure: PressureState | None = None
    ahead: Ahead | None = None


def check_step(
    state: ControllerState, measurement: Measurement, target: Target, k: int, shape: ShapeFeedback | None = None
) -> torch.Size:
    """The leading shape of a step with k sensors, and a shape that may be told curvature; raises where its arguments do
    not fit each other.
    """
    places = None if shape is None else shape.shape.n_curvature
    vectors = {"target.x_d": target.x_d, "target.xdot_d": target.xdot_d}
    if measurement.tip is not None:
        vectors["measurement.tip"] = measurement.tip
    for name, vector in vectors.items():
        check_tensor(name, vector, (3,))
    check_tensor("measurement.T", measurement.T, (k, 4, 4))
    check_tensor("measurement.time", measurement.time, ())
    check_same(**{"state.q_bar": state.q_bar, "measurement.T": measurement.T, **vectors})
    leading = {name: (vector, 1) for name, vector in vectors.items()}
    leading |= {"measurement.T": (measurement.T, 3), "measurement.time": (measurement.time, 0)}
    for name, mask in {"mask": measurement.mask, "angular_mask": measurement.angular_mask}.items():
        if mask is not None:
            leading[f"measurement.{name}"] = (mask, 1)
    if measurement.curvature is not None:
        check_tensor("measurement.curvature", measurement.curvature, (places, 2))
        leading["measurement.curvature"] = (measurement.curvature, 2)
    return batch_shape(**{"state.q_bar": (state.q_bar, 1), "state.pi_hat": (state.pi_hat, 1), **leading})


def elapsed(before: Tensor, now: Tensor, limit: float, like: Tensor) -> Tensor:
    """The time (...) s between two stamps, at most `limit`, in the type of `like`: stamps may need more digits."""
    return (now - before).clamp(0.0, limit).to(like.dtype)


def measured_tip(
    measurement: Measurement, x_hat: Tensor, valid: Tensor, kinds: SensorKinds | None = None
) -> tuple[Tensor, Tensor]:
    """The end effector and whether it was measured; the model's where the measurement is masked or not finite, or where
    the last sensor's pose is of a row that is not valid (...), or that sensor measures no position.
    """
    if kinds is not None and kinds.names[-1] in INERTIAL and measurement.tip is None:
        return x_hat, torch.zeros_like(valid)
    if measurement.tip is not None:
        x, seen = measurement.tip, torch.isfinite(measurement.tip).all(-1)
    else:
        x = measurement.T[..., -1, :3, 3]
        seen = torch.isfinite(x).all(-1) & valid
        if measurement.mask is not None:
            seen = seen & measurement.mask[..., -1]
    return torch.where(seen.unsqueeze(-1), x, x_hat), seen
