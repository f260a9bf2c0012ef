"""Replay: a made-up arm is followed through every fault, the real one within bounds, and bad input is named."""

from __future__ import annotations

import dataclasses
import math
from pathlib import Path

import numpy as np
import pytest
import torch
from scipy.signal import savgol_filter
from scipy.spatial.transform import Rotation
from torch import Tensor

from apcc_torch.control.adaptation import AdaptiveLaw
from apcc_torch.control.controller import APCCController
from apcc_torch.control.inverse_kinematics import InverseKinematics
from apcc_torch.control.step_io import Measurement, Target
from apcc_torch.errors import ConfigError, DataError, ShapeError, ValueRangeError
from apcc_torch.estimation.feedback import FeedbackStatus
from apcc_torch.estimation.rest_calibration import RestCalibration
from apcc_torch.estimation.savitzky_golay import SavitzkyGolay
from apcc_torch.estimation.sensor_gate import Reason, SensorGate, gate_recording
from apcc_torch.estimation.state_feedback import StateFeedback
from apcc_torch.model.abscissae import decouple
from apcc_torch.model.backbone import PCCBackbone
from apcc_torch.recordings.held_out import held_out_error
from apcc_torch.recordings.recorded_arm import TRUNK_BASE, gate_frames, recorded_arm
from apcc_torch.recordings.recording import Recording
from apcc_torch.recordings.recording_file import load_recording
from apcc_torch.recordings.replay import replay
from apcc_torch.recordings.replay_log import read_replay, replay_metrics, sensor_errors, write_replay
from apcc_torch.recordings.rest_pose import poses_of
from arms import HANGING_BASE
from laws import generator, normal, rotations

NAMES = ("low", "middle", "tip")
PI = torch.tensor([0.1, 0.12, 0.11], dtype=torch.float64)
X = PI.cumsum(0)
REST, FRAMES = 20, 260
NOISE_M, NOISE_RAD = 5e-5, 1e-3


def made_up_motion() -> tuple[Tensor, Tensor]:
    """Times (T,) and smooth configurations (T, 9) of a three-section arm that first rests."""
    times = torch.arange(FRAMES, dtype=torch.float64) / 100
    moving = (times - REST / 100).clamp(min=0.0).unsqueeze(-1)
    speed = torch.linspace(1.0, 2.2, 9, dtype=torch.float64)
    size = torch.tensor([0.45, 0.45, 0.006] * 3, dtype=torch.float64)
    return times, size * torch.sin(speed * moving) * torch.tanh(3 * moving)


def made_up_recording(base: Tensor | None = None, noise: float = 0.0) -> tuple[Recording, Tensor, PCCBackbone]:
    """A recording of that arm in a turned, shifted frame by sensors that sit askew, its true q and its backbone."""
    rng = generator(3)
    backbone = PCCBackbone(3, base)
    times, q = made_up_motion()
    T = backbone.pose(q, PI, *decouple(X, PI))
    world, mounts = rotations((), torch.float64, rng), rotations((3,), torch.float64, rng)
    jitter = Rotation.from_rotvec(noise * NOISE_RAD * normal((FRAMES * 3, 3), torch.float64, rng).numpy()).as_matrix()
    axes = world @ T[..., :3, :3] @ torch.from_numpy(jitter).reshape(FRAMES, 3, 3, 3) @ mounts
    point = T[..., :3, 3] + noise * NOISE_M * normal((FRAMES, 3, 3), torch.float64, rng)
    quaternion = torch.from_numpy(Rotation.from_matrix(axes.reshape(-1, 3, 3).numpy()).as_quat()).reshape(-1, 3, 4)
    # A bracket holds each body's origin 8 mm off its point on the arm.
    position = point @ world.mT + torch.tensor([0.3, 0.1, -0.2], dtype=torch.float64) + 0.008 * axes[..., 0]
    inputs = (torch.arange(FRAMES) >= REST).to(torch.float64).unsqueeze(-1)
    tracked = torch.ones(FRAMES, 3, dtype=torch.bool)
    return Recording(NAMES, times, position, quaternion, tracked, inputs, source="made up"), q, backbone


def made_up_calibration(recording: Recording, base: Tensor) -> RestCalibration:
    """What the made-up arm is known by: the recording's frame and the mounts, from its own construction."""
    rng = generator(3)
    world, mounts = rotations((), torch.float64, rng), rotations((3,), torch.float64, rng)
    # axes = world base R_model mounts (mounts turns the model's axes into the sensor's place): R_mount = mounts^T.
    offset = torch.tensor([-0.008, 0.0, 0.0], dtype=torch.float64).expand(3, 3)
    shift = torch.tensor([0.3, 0.1, -0.2], dtype=torch.float64)
    return RestCalibration(NAMES, shift, world @ base, mounts.mT, offset, X)


def gate() -> SensorGate:
    return SensorGate(X)


def feedback(backbone: PCCBackbone, mode: str = "pose", **settings: float) -> StateFeedback:
    return StateFeedback(backbone, X, mode, 0.1, max_iterations=12, settled_step=1e-6, **settings)


def controller(backbone: PCCBackbone, adaptive: bool = True) -> APCCController:
    law = AdaptiveLaw(3, 0.5)
    return APCCController(
        backbone,
        feedback(backbone),
        SavitzkyGolay(7, 2),
        InverseKinematics(2.0, null_gain=0.05),
        law,
        adaptive=adaptive,
    )


def identity_base() -> Tensor:
    return torch.eye(3, dtype=torch.float64)


@pytest.mark.parametrize("base", [None, HANGING_BASE])
@pytest.mark.parametrize("mode", ["position", "pose"])
def test_a_known_motion_is_recovered(mode: str, base: Tensor | None) -> None:
    recording, q, backbone = made_up_recording(base)
    calibration = made_up_calibration(recording, identity_base() if base is None else base)
    exact = feedback(backbone, mode, linear_threshold=1e-9, angular_threshold=1e-8)
    log = replay(recording, calibration, exact, gate(), parallel=True)
    torch.testing.assert_close(log.q_bar, q, atol=1e-5, rtol=0)
    torch.testing.assert_close(log.tip, backbone.tip(q, PI), atol=1e-6, rtol=0)
    errors = sensor_errors(log, exact)
    assert float(errors.linear.max()) < 1e-6 and float(errors.angular.max()) < 1e-5
    # The velocity is the filter's, which scipy has too.
    want = savgol_filter(log.q_bar.numpy(), 15, 2, deriv=1, delta=0.01, axis=0, mode="interp")
    # scipy fits its last window at once: only the last frame of each window is causal, so compare the log's last one.
    np.testing.assert_allclose(log.qdot_bar[-1].numpy(), want[-1], atol=1e-8)


class Faults:
    """A recording with every kind of fault, and where they are."""

    def __init__(self) -> None:
        clean, self.q, self.backbone = made_up_recording(noise=1.0)
        position, quaternion = clean.position.clone(), clean.quaternion.clone()
        tracked = clean.tracked.clone()
        self.position = torch.zeros(FRAMES, 3, dtype=torch.int64)
        self.orientation = torch.zeros(FRAMES, 3, dtype=torch.int64)

        def mark(frames: slice, sensor: int, orientation: Reason, position: Reason = Reason.OK) -> None:
            self.orientation[frames, sensor], self.position[frames, sensor] = int(orientation), int(position)

        # A marker swap: the body's own axes are mistaken, by 2 rad about the arm.
        swap, mount = slice(60, 95), made_up_calibration(clean, identity_base()).mount_rotation[1]
        turn = Rotation.from_rotvec((2.0 * mount[:, 2]).numpy())
        swapped = Rotation.from_quat(quaternion[swap, 1].numpy()) * turn
        quaternion[swap, 1] = torch.from_numpy(swapped.as_quat())
        mark(swap, 1, Reason.TWISTED)
        tracked[110:130, 2], position[110:130, 2], quaternion[110:130, 2] = False, math.nan, math.nan
        mark(slice(110, 130), 2, Reason.UNTRACKED, Reason.UNTRACKED)
        position[140, 0, 1] = math.nan
        mark(slice(140, 141), 0, Reason.NON_FINITE, Reason.NON_FINITE)
        quaternion[150:153, 2] = 0.0
        mark(slice(150, 153), 2, Reason.NOT_A_ROTATION, Reason.NOT_A_ROTATION)
        position[170, 1] += 0.06
        mark(slice(170, 171), 1, Reason.OK, Reason.JUMP)
        position[180, 2] += 5.0
        mark(slice(180, 181), 2, Reason.OK, Reason.OUT_OF_REACH)
        self.recording = dataclasses.replace(clean, position=position, quaternion=quaternion, tracked=tracked)
        self.calibration = made_up_calibration(clean, identity_base())


def test_every_fault_is_gated_and_nothing_else() -> None:
    made = Faults()
    arm = feedback(made.backbone)
    log = replay(made.recording, made.calibration, arm, gate(), parallel=True)
    assert torch.equal(log.orientation_reason, made.orientation)
    assert torch.equal(log.position_reason, made.position)
    assert all(bool(values.isfinite().all()) for values in log if values.is_floating_point())
    assert not bool((log.status == int(FeedbackStatus.INVALID)).any())
    # Noise of 0.05 mm and 1 mrad, over sections of 0.1 m: the shape follows the arm, also in the frames with a fault.
    faulty = ((made.orientation != 0) | (made.position != 0)).any(-1)
    tip_error = (log.tip - made.backbone.tip(made.q, PI)).norm(dim=-1)
    bend_error = (log.q_bar - made.q).unflatten(-1, (3, 3))[..., :2].abs()
    assert float(tip_error[~faulty].max()) < 3e-4
    # A swap costs the orientation alone, for the bracket of 8 mm is then turned by the rotation held, some 0.1 rad old.
    assert float(tip_error[60:95].max()) < 1.5e-3
    assert float(bend_error[~faulty].max()) < 0.01
    # With the tip lost its section stays where it was, and is found at once when it is back.
    assert float(bend_error[110:130, :2].max()) < 0.01
    assert float(bend_error[130].max()) < 0.01

    metrics = replay_metrics(log, NAMES, arm)
    assert metrics["frames"] == FRAMES and metrics["invalid_frames"] == 0
    assert metrics["gated_orientation_frames_middle_twisted"] == metrics["gated_orientation_frames_middle"] == 35
    assert metrics["gated_position_frames_tip"] == 24 and metrics["gated_position_frames_tip_untracked"] == 20
    assert metrics["gated_position_frames_low_non_finite"] == 1
    assert 0.01 < metrics["sensor_error_linear_mean_mm"] < 0.2
    assert metrics["sensor_error_angular_mean_rad"] < 3e-3
    mean = 1e3 * float(sensor_errors(log, arm).linear.nanmean())
    assert mean == pytest.approx(metrics["sensor_error_linear_mean_mm"], rel=1e-12)


def test_a_frozen_body_is_seen_in_the_residual() -> None:
    # Repeated poses pass a gate, as a still arm's do; the other sensors contradict them.
    recording, _, backbone = made_up_recording()
    position, quaternion = recording.position.clone(), recording.quaternion.clone()
    position[100:140, 1], quaternion[100:140, 1] = position[100, 1], quaternion[100, 1]
    frozen = dataclasses.replace(recording, position=position, quaternion=quaternion)
    arm, calibration = feedback(backbone), made_up_calibration(recording, identity_base())
    linear = replay(frozen, calibration, arm, gate(), parallel=True).linear_error.amax(-1)
    assert float(linear[:100].max()) < 1e-4 and float(linear[130:140].min()) > 1e-3
    assert float(linear[145:].max()) < 1e-4


def test_frames_at_once_are_frames_one_by_one() -> None:
    made = Faults()
    arm = feedback(made.backbone)
    rows = torch.stack((PI, PI * 1.02))
    part = slice(90, 160)
    one = replay(made.recording, made.calibration, arm, gate(), rows, frames=part)
    many = replay(made.recording, made.calibration, arm, gate(), rows, frames=part, parallel=True)
    torch.testing.assert_close(many.q_bar, one.q_bar, atol=1e-5, rtol=0)
    assert torch.equal(many.status, one.status)
    # Rows are replays of their own.
    for row in range(2):
        alone = replay(made.recording, made.calibration, arm, gate(), rows[row], frames=part, parallel=True)
        torch.testing.assert_close(many.q_bar[:, row], alone.q_bar, atol=1e-7, rtol=0)
        torch.testing.assert_close(many.qdot_bar[:, row], alone.qdot_bar, atol=1e-5, rtol=0)
    # A sensor that is not shown has no say.
    moved = made.recording.position.clone()
    moved[:, 1] += 0.002
    hidden = torch.tensor([True, False, True])
    logs = [
        replay(dataclasses.replace(made.recording, position=p), made.calibration, arm, gate(), mask=hidden, frames=part)
        for p in (made.recording.position, moved)
    ]
    assert torch.equal(logs[0].q_bar, logs[1].q_bar)


def test_the_gate_judges_all_frames_at_once_as_one_by_one() -> None:
    made = Faults()
    T = poses_of(made.calibration, made.recording)
    position = made.recording.position.clone()
    position[100:, 0] += 0.05  # gone for good: accepted again once the allowance has grown
    shifted = poses_of(made.calibration, dataclasses.replace(made.recording, position=position))
    for poses in (T, shifted):
        held, verdict = gate_frames(gate(), poses, made.recording.tracked, made.recording.times)
        want_held, want = gate_recording(gate(), poses, made.recording.tracked, made.recording.times)
        assert torch.equal(held, want_held)
        assert all(torch.equal(a, b) for a, b in zip(verdict, want, strict=True))


def test_float32_and_progress() -> None:
    recording, q, backbone = made_up_recording()
    seen: list[int] = []
    log = replay(
        recording,
        made_up_calibration(recording, identity_base()),
        feedback(backbone),
        gate(),
        PI.float(),
        frames=slice(0, 60, 2),
        progress=lambda steps: (seen.append(i) or i for i in steps),
    )
    assert seen == list(range(30)) and log.q_bar.dtype == torch.float32 and log.time.dtype == torch.float64
    torch.testing.assert_close(log.q_bar.double(), q[0:60:2], atol=2e-3, rtol=0)


def test_a_controller_runs_whole_towards_the_recorded_target() -> None:
    recording, _, backbone = made_up_recording(HANGING_BASE)
    calibration = made_up_calibration(recording, HANGING_BASE)
    x_d = torch.tensor([0.05, 0.02, -0.3], dtype=torch.float64) * (1 + 0.1 * recording.times.sin().unsqueeze(-1))
    # The target in the recording frame: from the world through the base, as the calibration knows it.
    target = (x_d @ HANGING_BASE) @ calibration.base_rotation.mT + calibration.base_position
    recording = dataclasses.replace(recording, target=target)
    pilot, part = controller(backbone), slice(0, 60)
    log = replay(recording, calibration, pilot, gate(), 1.05 * PI, frames=part)

    state = pilot.initial_state(torch.zeros(9, dtype=torch.float64), 1.05 * PI, recording.times[0])
    T = backbone.pose(made_up_motion()[1], PI, *decouple(X, PI))
    for i in range(60):
        rate = (x_d[i] - x_d[i - 1]) * 100 if i else torch.zeros(3, dtype=torch.float64)
        torch.testing.assert_close(log.pi_hat[i], state.pi_hat, atol=1e-7, rtol=0)
        state, command = pilot(state, Measurement(T[i], recording.times[i]), Target(x_d[i], rate))
        torch.testing.assert_close(log.e[i], command.e, atol=1e-9, rtol=0)
        torch.testing.assert_close(log.q_bar[i], state.q_bar, atol=1e-5, rtol=0)
    assert float((log.pi_hat[-1] - 1.05 * PI).abs().max()) > 1e-6
    assert "end_effector_error_mean_mm" in replay_metrics(log, NAMES, pilot.feedback)
    with pytest.raises(ConfigError, match="parallel must be False"):
        replay(recording, calibration, pilot, gate(), parallel=True)


def test_adaptation_without_a_target_is_refused_in_words() -> None:
    recording, _, backbone = made_up_recording()
    calibration = made_up_calibration(recording, identity_base())
    with pytest.raises(ConfigError, match="adaptation needs a target, and the recording 'made up' has none"):
        replay(recording, calibration, controller(backbone), gate())
    # A controller that only looks on is its estimator and its filter.
    part = slice(0, 40)
    alone = replay(recording, calibration, feedback(backbone), gate(), velocity_filter=SavitzkyGolay(7, 2), frames=part)
    held = replay(recording, calibration, controller(backbone, adaptive=False), gate(), frames=part)
    assert torch.equal(alone.q_bar, held.q_bar) and torch.equal(alone.qdot_bar, held.qdot_bar)
    assert not bool(held.e.any())


def test_the_filter_runs_as_it_would_frame_by_frame() -> None:
    recording, _, backbone = made_up_recording()
    smooth = SavitzkyGolay(7, 2)
    log = replay(
        recording,
        made_up_calibration(recording, identity_base()),
        feedback(backbone),
        gate(),
        velocity_filter=smooth,
        frames=slice(0, 30),
    )
    state = smooth.initial_state(log.q_bar[0], log.time[0])
    for i in range(30):
        state, derivative = smooth(state, log.q_bar[i], log.time[i])
        torch.testing.assert_close(log.qdot_bar[i], derivative)


def test_a_held_out_sensor_on_a_single_arc_is_predicted() -> None:
    # Where the arm has as few sections as sensors left, a fit without one sensor predicts it exactly.
    recording, _, backbone = made_up_recording()
    curve = made_up_motion()[1].clone()
    curve[:, 6:] = curve[:, 3:6] * PI[2] / PI[1]  # sections 2 and 3 are one arc
    T = backbone.pose(curve, PI, *decouple(X, PI))
    calibration = dataclasses.replace(
        made_up_calibration(recording, identity_base()),
        base_position=torch.zeros(3, dtype=torch.float64),
        base_rotation=identity_base(),
        mount_rotation=identity_base().repeat(3, 1, 1),
        mount_offset=torch.zeros(3, 3, dtype=torch.float64),
    )
    quaternion = torch.from_numpy(Rotation.from_matrix(T[..., :3, :3].reshape(-1, 3, 3).numpy()).as_quat())
    recording = dataclasses.replace(recording, position=T[..., :3, 3], quaternion=quaternion.reshape(-1, 3, 4))
    errors = held_out_error(recording, calibration, feedback(backbone, "position"), gate(), frames=slice(0, None, 5))
    assert errors.linear.shape == (FRAMES // 5, 2)
    assert float(errors.linear[:, 1].max()) < 2e-4 and float(errors.angular[:, 1].max()) < 5e-3
    assert float(errors.linear[:, 0].max()) > 1e-3  # sections 1 and 2 are not one arc


def test_a_replay_file_is_whole_or_not_there(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    recording, _, backbone = made_up_recording()
    log = replay(
        recording, made_up_calibration(recording, identity_base()), feedback(backbone), gate(), frames=slice(0, 9)
    )
    path = write_replay(tmp_path / "run", log)
    back = read_replay(tmp_path / "run")
    assert all(torch.equal(a, b) and a.dtype == b.dtype for a, b in zip(back, log, strict=True))
    before = path.read_bytes()

    def fails(*_: object) -> None:
        raise OSError("disk full")

    with monkeypatch.context() as broken:
        broken.setattr("os.fsync", fails)
        with pytest.raises(OSError, match="disk full"):
            write_replay(tmp_path / "run", log._replace(time=log.time + 1))
    assert path.read_bytes() == before and [p.name for p in path.parent.iterdir()] == ["replay.npz"]
    path.write_bytes(before[: len(before) // 2])
    with pytest.raises(DataError, match=r"replay\.npz: cannot be read as a replay"):
        read_replay(tmp_path / "run")
    with pytest.raises(DataError, match="cannot be read as a replay"):
        read_replay(tmp_path / "nothing")


def test_bad_recordings_and_arguments_give_one_clear_error() -> None:
    recording, _, backbone = made_up_recording()
    calibration, arm = made_up_calibration(recording, identity_base()), feedback(backbone)
    lost = dataclasses.replace(recording, tracked=torch.zeros_like(recording.tracked))
    with pytest.raises(DataError, match="made up: the gate accepts no position in any of the 260 frames"):
        replay(lost, calibration, arm, gate())
    with pytest.raises(DataError, match="go backward"):
        replay(dataclasses.replace(recording, times=recording.times.flip(0)), calibration, arm, gate())
    with pytest.raises(DataError, match="no frames"):
        replay(recording, calibration, arm, gate(), frames=slice(300, None))
    with pytest.raises(DataError, match="has the bodies"):
        replay(dataclasses.replace(recording, names=("a", "b", "c")), calibration, arm, gate())
    with pytest.raises(ShapeError, match="gate has 2 sensors"):
        replay(recording, calibration, arm, SensorGate(X[:2]))
    with pytest.raises(ShapeError, match="L0 must have shape"):
        replay(recording, calibration, arm, gate(), PI[:2])
    aimless = dataclasses.replace(recording, target=torch.full((FRAMES, 3), math.nan, dtype=torch.float64))
    with pytest.raises(DataError, match="target is not finite"):
        replay(aimless, calibration, controller(backbone), gate())
    log = replay(recording, calibration, arm, gate(), torch.stack((PI, PI)), frames=slice(0, 3))
    with pytest.raises(ShapeError, match="single row"):
        replay_metrics(log, NAMES, arm)
    mounts = {"mount_rotation": calibration.mount_rotation[:1], "mount_offset": calibration.mount_offset[:1]}
    single = dataclasses.replace(calibration, names=("low",), abscissae=X[:1], **mounts)
    with pytest.raises(ValueRangeError, match="two sensors"):
        held_out_error(recording, single, arm, gate())


@pytest.fixture(scope="module")
def trunk(shared_data: Path) -> Recording:
    return load_recording(shared_data / "trunk", layout="trunk")


def test_the_recorded_trunk_is_followed(trunk: Recording) -> None:
    part = slice(2000, 2600)
    found = {}
    for mode in ("position", "pose", "hierarchical"):
        arm = recorded_arm(trunk, mode=mode)
        log = replay(trunk, arm.calibration, arm.feedback, arm.gate, frames=part, parallel=True)
        held_out = held_out_error(trunk, arm.calibration, arm.feedback, arm.gate, frames=part)
        found[mode] = replay_metrics(log, trunk.names, arm.feedback, held_out)
        assert found[mode]["invalid_frames"] == 0 and found[mode]["iteration_limit_frames"] <= 12
        assert not bool((log.status == int(FeedbackStatus.INVALID)).any())
    # Three sections reach three positions; the rotations that they imply are a prediction.
    for mode in ("position", "hierarchical"):
        assert found[mode]["sensor_error_linear_mean_mm"] < 0.02
        assert found[mode]["sensor_error_angular_mean_rad"] < 0.08
    assert 0.1 < found["pose"]["sensor_error_linear_mean_mm"] < 1.5
    assert found["pose"]["sensor_error_angular_mean_rad"] < 0.02
    for metrics in found.values():
        assert metrics["held_out_error_linear_mean_mm_disk1"] < 6.0
        assert metrics["held_out_error_linear_mean_mm_disk2"] < 10.0
        assert metrics["elongation_max_mm"] < 30.0 and metrics["bend_max_rad"] < 2.0
        assert metrics["gated_orientation_frames_disk1"] == 0
        assert metrics["gated_orientation_frames_disk2_twisted"] > 100


def test_the_base_of_the_recorded_trunk_makes_elongation_independent_of_bending(trunk: Recording) -> None:
    spread = []
    for base in (None, TRUNK_BASE):
        arm = recorded_arm(trunk, base_position=base)
        q = replay(trunk, arm.calibration, arm.feedback, arm.gate, frames=slice(0, None, 12), parallel=True).q_bar
        spread.append(q[:, 2::3].std(0))
    assert bool((spread[1] < spread[0]).all()) and float(spread[0][2]) > 6e-3 and float(spread[1].max()) < 3e-3


def test_swaps_of_the_recorded_trunk_do_not_show(trunk: Recording) -> None:
    arm = recorded_arm(trunk)
    log = replay(trunk, arm.calibration, arm.feedback, arm.gate, frames=slice(4000, 4600), parallel=True)
    middle = sensor_errors(log, arm.feedback).linear[:, 1]
    swapped = log.orientation_reason[:, 1] != int(Reason.OK)
    assert int(swapped.sum()) > 50
    # The bracket is 5 mm: placed by the swapped rotation the disk would be 9 mm off.
    assert float(middle[swapped].mean()) < 2.5e-3
