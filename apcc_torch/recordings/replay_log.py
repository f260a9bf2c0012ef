"""The log of a replay: how well the shape fits the sensors, what the gate held back, and the file it is kept in."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import torch
from torch import Tensor

from apcc_torch.errors import DataError, ShapeError
from apcc_torch.estimation.feedback import FeedbackStatus
from apcc_torch.estimation.sensor_gate import Reason
from apcc_torch.estimation.state_feedback import StateFeedback
from apcc_torch.files import read_arrays, write_arrays
from apcc_torch.lie.rotations import rotation_angle
from apcc_torch.model.abscissae import decouple


class ReplayLog(NamedTuple):
    """A replay of N frames, time first; "..." are the rows of `replay`'s arguments.

    time: (N,) s.
    poses: (N, k, 4, 4) measured sensor poses, world frame, m; the last accepted one where the gate held one back.
    q_bar: (N, ..., 3 n_b) inferred configuration.
    qdot_bar: (N, ..., 3 n_b) its filtered velocity, rad/s and m/s.
    pi_hat: (N, ..., n_b) parameters with which q_bar was inferred, m.
    angular_error: (N, ..., k) rad, and linear_error: (N, ..., k) m, of algorithm 2 in its own measure; 0 where not
        used. `sensor_errors` measures all modes alike.
    iterations: (N, ...) int64.
    status: (N, ...) int64 `FeedbackStatus`.
    position_reason: (N, k) int64 `Reason`.
    orientation_reason: (N, k) int64 `Reason`.
    tip: (N, ..., 3) the model's tip at q_bar and pi_hat, world frame, m.
    e: (N, ..., 3) the controller's error x_d - x, m; zero without a controller.
    """

    time: Tensor
    poses: Tensor
    q_bar: Tensor
    qdot_bar: Tensor
    pi_hat: Tensor
    angular_error: Tensor
    linear_error: Tensor
    iterations: Tensor
    status: Tensor
    position_reason: Tensor
    orientation_reason: Tensor
    tip: Tensor
    e: Tensor


class SensorErrors(NamedTuple):
    """Distance and angle between measured and modelled sensors; NaN where the gate did not accept the measurement.

    linear: (N, ..., k) m.
    angular: (N, ..., k) rad.
    """

    linear: Tensor
    angular: Tensor


def sensor_errors(log: ReplayLog, feedback: StateFeedback) -> SensorErrors:
    """How far the inferred shape is from every accepted measurement, in metres and radians whatever the mode.

    Sensors that `replay`'s mask left out are measured too.
    """
    X_tilde, j = decouple(feedback.abscissae.to(log.pi_hat), log.pi_hat)
    model = feedback.backbone.pose(log.q_bar, log.pi_hat, X_tilde, j)

    def per_frame(values: Tensor, inner: int) -> Tensor:
        rows = [1] * (log.q_bar.dim() - 2)
        return values.reshape(len(values), *rows, *values.shape[values.dim() - inner :])

    measured = per_frame(log.poses, 3)
    linear = (measured[..., :3, 3] - model[..., :3, 3]).norm(dim=-1)
    angular = rotation_angle(measured[..., :3, :3], model[..., :3, :3])
    return SensorErrors(
        torch.where(per_frame(log.position_reason, 1) == int(Reason.OK), linear, torch.nan),
        torch.where(per_frame(log.orientation_reason, 1) == int(Reason.OK), angular, torch.nan),
    )


def _mean(values: Tensor) -> float:
    return float(values[values.isfinite()].mean())


def _max(values: Tensor) -> float:
    kept = values[values.isfinite()]
    return float(kept.max()) if len(kept) else float("nan")


def replay_metrics(
    log: ReplayLog, names: Sequence[str], feedback: StateFeedback, held_out: SensorErrors | None = None
) -> dict[str, float]:
    """Flat name -> number of a replay with a single row; a mean over nothing is NaN.

    Args:
        log: The replay.
        names: The sensors' names, k of them.
        feedback: Its estimator.
        held_out: From `held_out_error`; None leaves those entries out.

    Raises:
        ShapeError: The log has more than one row, or `names` is not one a sensor.

    Example:
        >>> place = torch.tensor([[0.0, 0.0, -0.2], [0.0, 0.0, -0.45]]).double().expand(50, 2, 3)
        >>> turn = torch.tensor([1.0, 0.0, 0.0, 0.0]).double().expand(50, 2, 4)
        >>> still = Recording(("middle", "tip"), torch.arange(50).double() / 100, place, turn, torch.ones(50, 2).bool())
        >>> arm = recorded_arm(still, direction=None, rest=50, base_position=[0.0, 0.0, 0.0])
        >>> log = replay(still, arm.calibration, arm.feedback, arm.gate)
        >>> replay_metrics(log, still.names, arm.feedback)["converged_frames"]
        50
    """
    if log.q_bar.dim() != 2:
        raise ShapeError(f"log must have a single row, q_bar of shape (N, n), got {tuple(log.q_bar.shape)}")
    if len(names) != log.position_reason.shape[-1]:
        raise ShapeError(f"names must have {log.position_reason.shape[-1]} entries, got {len(names)}")
    metrics: dict[str, float] = {"frames": len(log.time)}
    for status in FeedbackStatus:
        metrics[f"{status.name.lower()}_frames"] = int((log.status == int(status)).sum())
    metrics["iterations_mean"] = float(log.iterations.to(torch.float64).mean())
    errors = sensor_errors(log, feedback)
    for what, unit, factor, values in (("linear", "mm", 1e3, errors.linear), ("angular", "rad", 1.0, errors.angular)):
        metrics[f"sensor_error_{what}_mean_{unit}"] = factor * _mean(values)
        metrics[f"sensor_error_{what}_max_{unit}"] = factor * _max(values)
        for i, name in enumerate(names):
            metrics[f"sensor_error_{what}_mean_{unit}_{name}"] = factor * _mean(values[:, i])
    for i, name in enumerate(names):
        metrics[f"gated_position_frames_{name}"] = int((log.position_reason[:, i] != int(Reason.OK)).sum())
        metrics[f"gated_orientation_frames_{name}"] = int((log.orientation_reason[:, i] != int(Reason.OK)).sum())
        for reason in list(Reason)[1:]:
            for what, codes in (("position", log.position_reason), ("orientation", log.orientation_reason)):
                count = int((codes[:, i] == int(reason)).sum())
                if count:
                    metrics[f"gated_{what}_frames_{name}_{reason.name.lower()}"] = count
        if held_out is not None and i < held_out.linear.shape[-1]:
            metrics[f"held_out_error_linear_mean_mm_{name}"] = 1e3 * _mean(held_out.linear[:, i])
            metrics[f"held_out_error_angular_mean_rad_{name}"] = _mean(held_out.angular[:, i])
    coordinates = feedback.backbone.coordinates
    metrics["elongation_max_mm"] = 1e3 * float(log.q_bar[:, coordinates.elongations].abs().max())
    metrics["bend_max_rad"] = float(coordinates.bends(log.q_bar).norm(dim=-1).max())
    if bool(log.e.any()):
        metrics["end_effector_error_mean_mm"] = 1e3 * _mean(log.e.norm(dim=-1))
    return metrics


def write_replay(folder: str | Path, log: ReplayLog) -> Path:
    """Writes replay.npz, whole or not at all: one array for each field of `ReplayLog`, of its name, shape and unit.

    Args:
        folder: Where to; made if it is not there.
        log: The replay.

    Returns:
        The file.

    Example:
        >>> place = torch.tensor([[0.0, 0.0, -0.2], [0.0, 0.0, -0.45]]).double().expand(50, 2, 3)
        >>> turn = torch.tensor([1.0, 0.0, 0.0, 0.0]).double().expand(50, 2, 4)
        >>> still = Recording(("middle", "tip"), torch.arange(50).double() / 100, place, turn, torch.ones(50, 2).bool())
        >>> arm = recorded_arm(still, direction=None, rest=50, base_position=[0.0, 0.0, 0.0])
        >>> log = replay(still, arm.calibration, arm.feedback, arm.gate)
        >>> with TemporaryDirectory() as folder:
        ...     read_replay(write_replay(folder, log).parent).q_bar.equal(log.q_bar)
        True
    """
    return write_arrays(Path(folder) / "replay.npz", log._asdict())


def read_replay(folder: str | Path) -> ReplayLog:
    """Reads what `write_replay` wrote.

    Raises:
        DataError: The file is missing, damaged, or lacks a field.

    Example:
        >>> place = torch.tensor([[0.0, 0.0, -0.2], [0.0, 0.0, -0.45]]).double().expand(50, 2, 3)
        >>> turn = torch.tensor([1.0, 0.0, 0.0, 0.0]).double().expand(50, 2, 4)
        >>> still = Recording(("middle", "tip"), torch.arange(50).double() / 100, place, turn, torch.ones(50, 2).bool())
        >>> arm = recorded_arm(still, direction=None, rest=50, base_position=[0.0, 0.0, 0.0])
        >>> log = replay(still, arm.calibration, arm.feedback, arm.gate)
        >>> with TemporaryDirectory() as folder:
        ...     read_replay(write_replay(folder, log).parent).q_bar.equal(log.q_bar)
        True
    """
    path = Path(folder) / "replay.npz"
    try:
        content = read_arrays(path)
        return ReplayLog(**{name: content[name] for name in ReplayLog._fields})
    except (DataError, KeyError) as error:
        raise DataError(f"{path}: cannot be read as a replay ({error})") from error
