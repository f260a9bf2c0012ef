"""Replay of a recording: the gate, and algorithm 2 or the whole controller, frame by frame over what an arm did."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from apcc_torch.control.controller import APCCController
from apcc_torch.control.step_io import Measurement, Target
from apcc_torch.errors import ConfigError, DataError, ShapeError
from apcc_torch.estimation.feedback import Feedback
from apcc_torch.estimation.rest_calibration import RestCalibration
from apcc_torch.estimation.savitzky_golay import SavitzkyGolay, SavitzkyGolayState
from apcc_torch.estimation.sensor_gate import GateVerdict, Reason, SensorGate
from apcc_torch.estimation.state_feedback import StateFeedback
from apcc_torch.lie import se3
from apcc_torch.model.kinematic_model import KinematicModel
from apcc_torch.recordings.recorded_arm import gate_frames
from apcc_torch.recordings.recording import Recording
from apcc_torch.recordings.replay_log import ReplayLog
from apcc_torch.recordings.rest_pose import poses_of, unturned
from apcc_torch.shapes import broadcast
from apcc_torch.simulation.progress import Progress, quiet

_BLOCK = 100  # frames a sweep


class _Frames(NamedTuple):
    """Gated frames as the estimator takes them."""

    time: Tensor  # (N,)
    T: Tensor  # (N, k, 4, 4), world frame, finite
    verdict: GateVerdict


def _frames(
    recording: Recording,
    calibration: RestCalibration,
    feedback: StateFeedback,
    gate: SensorGate,
    frames: slice,
    like: Tensor,
) -> _Frames:
    k = len(recording.names)
    for name, count in (("feedback", feedback.abscissae.shape[-1]), ("gate", gate.sensors)):
        if count != k:
            raise ShapeError(f"{name} has {count} sensors, the recording {recording.source!r} has {k} bodies")
    times = recording.times[frames]
    if not len(times):
        raise DataError(f"{recording.source}: the recording has no frames to replay")
    if not bool(times.isfinite().all()) or bool((times.diff() < 0).any()):
        raise DataError(f"{recording.source}: the time stamps are not finite, or go backward")
    tracked, position = recording.tracked[frames], recording.position[frames]
    T = poses_of(calibration, recording)[frames]
    turned, verdict = gate_frames(gate, T, tracked, times)
    # The mount's offset was turned by the measured rotation: where that is wrong the held one takes its place, so that
    # a good position is not lost, or shifted, with it.
    axes = calibration.base_rotation.to(T) @ turned[..., :3, :3] @ calibration.mount_rotation.to(T).mT
    placed = torch.where(verdict.orientation_ok[..., None, None], T, calibration.poses(position, axes))
    T = torch.cat((T[..., :3], placed[..., 3:]), dim=-1)
    held, verdict = gate_frames(gate, T, tracked, times)
    if not bool(verdict.position_ok.any()):
        raise DataError(f"{recording.source}: the gate accepts no position in any of the {len(times)} frames")
    alone = unturned(recording)
    verdict = verdict._replace(
        orientation_ok=verdict.orientation_ok & ~alone,
        orientation_reason=torch.where(alone, int(Reason.UNTRACKED), verdict.orientation_reason),
    )
    base = feedback.backbone.base_rotation.to(held)
    world = se3.pose(base @ held[..., :3, :3], held[..., :3, 3] @ base.mT)
    return _Frames(times.to(like.device), world.to(like), GateVerdict(*(code.to(like.device) for code in verdict)))


def replay(
    recording: Recording,
    calibration: RestCalibration,
    estimator: StateFeedback | APCCController,
    gate: SensorGate,
    pi_hat: Tensor | None = None,
    mask: Tensor | None = None,
    velocity_filter: SavitzkyGolay | None = None,
    frames: slice = slice(None),
    parallel: bool = False,
    progress: Progress = quiet,
) -> ReplayLog:
    """Runs the estimator, or the whole controller, over a recording; each frame is seeded by the one before it.

    A controller runs whole, towards the recorded target, and adapts pi_hat as it would have done on the arm with these
    measurements; as the arm did not follow its command, the proof's V need not fall. Without a target there is no e,
    and the arm's own motion is no substitute: with q_bar inferred from the same sensors, the error of predicting the
    tip from J_hat qdot_bar is near zero whatever pi_hat is, and a law driven by it drifts. So a controller that
    adapts needs a target; one that does not (`adaptive=False`) then serves as the estimator it holds.

    Args:
        recording: The recording.
        calibration: Of its bodies.
        estimator: Algorithm 2 alone, or the controller that holds it. Its backbone's base rotation turns the
            calibration's base frame into the world.
        gate: Decides what the estimator is shown.
        pi_hat: (..., n_b) rest lengths, m, the first ones where a controller adapts; None: the calibration's, where
            one section ends at each sensor. The replay follows its dtype and device.
        mask: (..., k) bool, False for a sensor never shown to the estimator; None: all are shown.
        velocity_filter: Derivative of q_bar for an estimator alone; None: window 15, order 2.
        frames: Which frames, gated as if there were no others.
        parallel: For an estimator alone: many frames at once, in sweeps that each seed a frame by the last sweep's
            result for the frame before it, until no seed moves by the estimator's `settled_step`. The same to that
            precision and much faster, save where the sensors leave the shape open.
        progress: Wraps the frame counter (`parallel`: of blocks of frames), for a progress bar.

    Raises:
        ShapeError, DtypeError: Arguments do not fit each other.
        ConfigError: `parallel` is asked of a controller, or it adapts and the recording has no target.
        DataError: The recording has no frames, none of use, or bodies that are not the calibration's.

    Example:
        >>> place = torch.tensor([[0.0, 0.0, -0.2], [0.0, 0.0, -0.45]]).double().expand(50, 2, 3)
        >>> turn = torch.tensor([1.0, 0.0, 0.0, 0.0]).double().expand(50, 2, 4)
        >>> still = Recording(("middle", "tip"), torch.arange(50).double() / 100, place, turn, torch.ones(50, 2).bool())
        >>> arm = recorded_arm(still, direction=None, rest=50, base_position=[0.0, 0.0, 0.0])
        >>> log = replay(still, arm.calibration, arm.feedback, arm.gate)
        >>> log.q_bar.shape, bool((log.status == FeedbackStatus.CONVERGED).all())
        (torch.Size([50, 6]), True)
    """
    controller: APCCController | None = None
    if isinstance(estimator, StateFeedback):
        feedback = estimator
    else:
        feedback, velocity_filter = estimator.feedback, velocity_filter or estimator.velocity_filter
        if recording.target is not None:
            controller = estimator
        elif estimator.adaptive:
            raise ConfigError(f"adaptation needs a target, and the recording {recording.source!r} has none")
    if parallel and controller is not None:
        raise ConfigError("parallel must be False for a controller: its parameters come from the frames before")
    backbone = feedback.backbone
    pi_hat = calibration.rest_lengths if pi_hat is None else pi_hat
    q = pi_hat.new_zeros(backbone.n)
    backbone.check(q, pi_hat)
    gated = _frames(recording, calibration, feedback, gate, frames, pi_hat)
    shown, oriented = gated.verdict.position_ok, gated.verdict.orientation_ok
    if mask is None:
        mask = shown.new_ones(shown.shape[-1])
    batch = broadcast(pi_hat.shape[:-1], mask.shape[:-1])
    q, pi_hat = q.expand(*batch, backbone.n), pi_hat.expand(*batch, backbone.n_sections)
    per_frame = (len(shown), *[1] * len(batch), -1)
    shown, oriented = shown.reshape(per_frame) & mask, oriented.reshape(per_frame) & mask
    if controller is not None and recording.target is not None:
        x_d = _target(recording.target, recording, calibration, backbone, frames, pi_hat)
        return _run(controller, q, pi_hat, gated, shown, oriented, x_d, progress)
    estimate = _sweep if parallel else _follow
    result = estimate(feedback, q, pi_hat, gated.T, shown, oriented, progress)
    smooth = SavitzkyGolay(window=15, order=2) if velocity_filter is None else velocity_filter
    qdot_bar = _derivative(smooth, result.q_bar, gated.time)
    tip = backbone.tip(result.q_bar, pi_hat)
    pi_hat = pi_hat.expand(len(tip), *pi_hat.shape)
    codes = (gated.verdict.position_reason, gated.verdict.orientation_reason)
    return ReplayLog(
        gated.time, gated.T, result.q_bar, qdot_bar, pi_hat, *result[1:], *codes, tip, torch.zeros_like(tip)
    )


def _follow(
    feedback: StateFeedback, q: Tensor, pi_hat: Tensor, T: Tensor, shown: Tensor, oriented: Tensor, progress: Progress
) -> Feedback:
    """Algorithm 2 frame by frame."""
    rows = []
    for i in progress(range(len(T))):
        result = feedback(q, pi_hat, T[i], shown[i], oriented[i])
        q = result.q_bar
        rows.append(result)
    return Feedback(*(torch.stack(column) for column in zip(*rows, strict=True)))


def _sweep(
    feedback: StateFeedback, q: Tensor, pi_hat: Tensor, T: Tensor, shown: Tensor, oriented: Tensor, progress: Progress
) -> Feedback:
    """Algorithm 2 on blocks of frames at once, until every seed is the frame before's result.

    Blocks, as a frame far from its first seed may be fitted by a section wound round once more; that result then
    wanders from seed to seed, one frame a sweep, and the block's end stops it.
    """
    T = T.reshape(len(T), *[1] * (q.dim() - 1), *T.shape[1:])
    blocks = []
    for start in progress(range(0, len(T), _BLOCK)):
        part = [values[start : start + _BLOCK] for values in (T, shown, oriented)]
        seed = q.expand(len(part[0]), *q.shape)
        result: Feedback = feedback(seed, pi_hat, *part)
        for _ in range(_BLOCK):
            wanted = torch.cat((q.unsqueeze(0), result.q_bar[:-1]))
            index = ((wanted - seed).abs().flatten(1).amax(-1) > feedback.settled_step).nonzero().squeeze(-1)
            if not len(index):
                break
            anew = feedback(wanted[index], pi_hat, *(values[index] for values in part))
            seed = seed.index_copy(0, index, wanted[index])
            result = Feedback(*(old.index_copy(0, index, new) for old, new in zip(result, anew, strict=True)))
        q = result.q_bar[-1]
        blocks.append(result)
    return Feedback(*(torch.cat(column) for column in zip(*blocks, strict=True)))


def _derivative(smooth: SavitzkyGolay, q_bar: Tensor, time: Tensor) -> Tensor:
    """What the filter would have returned frame by frame, (N, ..., n)."""
    first = smooth.initial_state(q_bar[0], time[0])
    samples = torch.cat((first.samples.movedim(-2, 0)[1:], q_bar)).unfold(0, smooth.length, 1)  # (N, ..., n, window)
    missing = torch.zeros(smooth.length - 1, dtype=torch.bool, device=time.device)
    stamps = torch.cat((time[:1].expand(smooth.length - 1), time)).unfold(0, smooth.length, 1)
    valid = torch.cat((missing, torch.ones_like(time, dtype=torch.bool))).unfold(0, smooth.length, 1)
    per_frame = (len(time), *[1] * (q_bar.dim() - 2), smooth.length)
    state = SavitzkyGolayState(samples.mT, stamps.reshape(per_frame), valid.reshape(per_frame))
    return smooth.evaluate(state).derivative


def _target(
    position: Tensor,
    recording: Recording,
    calibration: RestCalibration,
    backbone: KinematicModel,
    frames: slice,
    like: Tensor,
) -> Target:
    """The recorded target in the world frame, (N, 3) m, and its backward difference, m/s; 0 for the first frame."""
    if not bool(position.isfinite().all()):
        raise DataError(f"{recording.source}: the target is not finite")
    x_d = calibration.points(position[frames]) @ backbone.base_rotation.to(position).mT
    elapsed = recording.times[frames].diff().unsqueeze(-1)
    xdot_d = torch.where(elapsed > 0, x_d.diff(dim=0) / elapsed, 0.0)
    return Target(x_d.to(like), torch.nn.functional.pad(xdot_d, (0, 0, 1, 0)).to(like))


def _run(
    controller: APCCController,
    q: Tensor,
    pi_hat: Tensor,
    gated: _Frames,
    shown: Tensor,
    oriented: Tensor,
    target: Target,
    progress: Progress,
) -> ReplayLog:
    """The controller frame by frame."""
    state = controller.initial_state(q, pi_hat, gated.time[0])
    rows = []
    for i in progress(range(len(gated.T))):
        before = state.pi_hat
        measurement = Measurement(gated.T[i], gated.time[i], shown[i], oriented[i])
        state, command = controller(state, measurement, Target(target.x_d[i], target.xdot_d[i]))
        rows.append((state.q_bar, state.qdot_bar, before, *command.feedback[1:], command.e))
    columns = [torch.stack(column) for column in zip(*rows, strict=True)]
    tip = controller.backbone.tip(columns[0], columns[2])
    codes = (gated.verdict.position_reason, gated.verdict.orientation_reason)
    return ReplayLog(*[gated.time, gated.T, *columns[:-1], *codes, tip, columns[-1]])
