"""Calibration: a made-up arm with known base and mounts is found again, and the real one hangs as it should."""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation
from torch import Tensor

from apcc_torch.errors import DataError, ValueRangeError
from apcc_torch.estimation.rest_calibration import RestCalibration
from apcc_torch.lie.rotations import chordal_mean, rotation_angle
from apcc_torch.recordings.recording import Recording
from apcc_torch.recordings.recording_file import load_recording
from apcc_torch.recordings.rest_pose import calibrate, poses_of, rest_frame_count
from laws import check_batching, generator, normal, poses, rotations

ABSCISSAE = torch.tensor([0.1, 0.22, 0.3], dtype=torch.float64)


def as_recording(position: Tensor, rotation: Tensor, inputs: Tensor | None = None) -> Recording:
    T, k = position.shape[:2]
    quaternion = Rotation.from_matrix(rotation.reshape(-1, 3, 3).numpy()).as_quat().reshape(T, k, 4)
    names = tuple("abcdefgh"[:k])
    times = torch.arange(T, dtype=torch.float64) / 100
    return Recording(names, times, position, torch.from_numpy(quaternion), torch.ones(T, k, dtype=torch.bool), inputs)


def made_up_arm(frames: int = 40, rest: int = 25) -> tuple[Recording, Tensor, Tensor, Tensor]:
    """An arm that moves after the rest, its base pose (4, 4), sensor-to-model mounts (3, 4, 4) and model poses."""
    rng = generator(5)
    base, mounts = poses((), torch.float64, rng), poses((3,), torch.float64, rng)
    mounts[:, :3, 3] *= 0.01
    model = poses((frames, 3), torch.float64, rng)
    model[:rest] = torch.eye(4, dtype=torch.float64)
    model[:rest, :, 2, 3] = ABSCISSAE
    sensors = base @ model @ torch.linalg.inv(mounts)
    inputs = torch.zeros(frames, 2, dtype=torch.float64)
    inputs[rest:, 1] = torch.arange(frames - rest, dtype=torch.float64) + 1
    return as_recording(sensors[..., :3, 3], sensors[..., :3, :3], inputs), base, mounts, model


def test_a_known_arm_is_found_again() -> None:
    recording, base, mounts, model = made_up_arm()
    c = calibrate(recording, direction=base[:3, 2], forward=base[:3, 0], base_position=base[:3, 3])
    assert c.rest_frames == 25
    torch.testing.assert_close(c.base_rotation, base[:3, :3])
    torch.testing.assert_close(c.mount_rotation, mounts[:, :3, :3])
    torch.testing.assert_close(poses_of(c, recording)[..., :3, :3], model[..., :3, :3])
    # Along the axis the place of a mount cannot be told from the abscissa; a rest pose is always the model's.
    rest = poses_of(c, recording)[0]
    torch.testing.assert_close(rest[:, :2, 3], torch.zeros(3, 2, dtype=torch.float64))
    torch.testing.assert_close(rest[:, 2, 3], c.abscissae)
    torch.testing.assert_close(c.rest_lengths.cumsum(0), c.abscissae)
    torch.testing.assert_close(c.points(base[:3, 3]), torch.zeros(3, dtype=torch.float64))


def test_sensors_on_the_axis_are_found_without_any_hint() -> None:
    recording, base, mounts, model = made_up_arm()
    sensors = base @ model
    recording = as_recording(sensors[..., :3, 3], sensors[..., :3, :3] @ mounts[:, :3, :3].mT, recording.inputs)
    c = calibrate(recording, first_abscissa=0.1)
    torch.testing.assert_close(c.abscissae, ABSCISSAE)
    torch.testing.assert_close(c.base_position, base[:3, 3])
    torch.testing.assert_close(c.base_rotation[:, 2], base[:3, 2])
    torch.testing.assert_close(c.mount_offset, torch.zeros(3, 3, dtype=torch.float64))
    # The base's x axis is free: all poses are the model's, seen from a base turned about z.
    turn = c.base_rotation.mT @ base[:3, :3]
    want = turn @ model[..., :3, 3:]
    torch.testing.assert_close(poses_of(c, recording)[..., :3, 3:], want)
    torch.testing.assert_close(poses_of(c, recording)[..., :3, :3], turn @ model[..., :3, :3] @ turn.mT)
    # Without a word on the base, the spacing is carried on.
    torch.testing.assert_close(calibrate(recording).abscissae, ABSCISSAE)


def test_rest_frames_are_judged_robustly() -> None:
    recording, *_ = made_up_arm()
    clean = calibrate(recording)
    position, quaternion, tracked = recording.position.clone(), recording.quaternion.clone(), recording.tracked.clone()
    position[3:8, 1] += 0.5  # a ghost for a while
    quaternion[4:9, 2] = torch.tensor([0.5, 0.5, -0.5, 0.5], dtype=torch.float64)  # a marker swap
    position[10, 0], tracked[11, 0], position[11, 0] = torch.nan, False, 9.0
    harmed = dataclasses.replace(recording, position=position, quaternion=quaternion, tracked=tracked)
    have = calibrate(harmed)
    for name in ("base_position", "base_rotation", "mount_rotation", "mount_offset", "abscissae"):
        torch.testing.assert_close(getattr(have, name), getattr(clean, name))
    assert have.rest_scatter_m > 0.4 and have.rest_scatter_rad > 0.5 and clean.rest_scatter_rad < 1e-6


def test_mounts_may_be_rotations_only() -> None:
    recording, *_ = made_up_arm()
    c = calibrate(recording, offsets=False)
    assert torch.equal(c.mount_offset, torch.zeros(3, 3, dtype=torch.float64))
    torch.testing.assert_close(poses_of(c, recording)[..., :3, 3], c.points(recording.position))


def test_the_chordal_mean_is_scipys() -> None:
    R = Rotation.from_rotvec(0.2 * np.random.default_rng(0).uniform(-1, 1, (30, 3)))
    have = chordal_mean(torch.from_numpy(R.as_matrix()))
    torch.testing.assert_close(have, torch.from_numpy(R.mean().as_matrix()), atol=1e-12, rtol=0)


def test_the_rotation_angle_is_scipys() -> None:
    R = rotations((20, 2), torch.float64, generator())
    want = (Rotation.from_matrix(R[:, 0].numpy()).inv() * Rotation.from_matrix(R[:, 1].numpy())).magnitude()
    torch.testing.assert_close(rotation_angle(R[:, 0], R[:, 1]), torch.from_numpy(want))


def test_rest_ends_where_the_inputs_move() -> None:
    recording, *_ = made_up_arm()
    assert rest_frame_count(recording) == 25
    still = dataclasses.replace(recording, inputs=torch.ones(40, 2, dtype=torch.float64))
    assert rest_frame_count(still) == 40
    ramp = 0.01 * torch.arange(40, dtype=torch.float64).view(-1, 1, 1)
    moving = dataclasses.replace(recording, inputs=None, position=recording.position[:1] + ramp)
    with pytest.raises(ValueRangeError, match="rest must be given"):
        calibrate(moving)
    assert calibrate(dataclasses.replace(recording, inputs=None)).rest_frames in (25, 26)
    assert calibrate(dataclasses.replace(recording, inputs=None), rest=20).rest_frames == 20


def test_poses_are_batched() -> None:
    recording, *_ = made_up_arm()
    c = calibrate(recording)
    check_batching(
        c.poses, lambda shape, dtype, rng: (normal((*shape, 3, 3), dtype, rng), rotations((*shape, 3), dtype, rng))
    )


def test_bad_arguments_are_named() -> None:
    recording, base, *_ = made_up_arm()
    for keywords, named in (
        ({"rest": 0}, "rest"),
        ({"rest": 41}, "rest"),
        ({"direction": (0.0, 0.0, 0.0)}, "direction"),
        ({"direction": base[:3, 2], "forward": base[:3, 2]}, "forward"),
        ({"base_position": base[:3, 3], "first_abscissa": 0.1}, "first_abscissa"),
        ({"first_abscissa": -0.1}, "base_position"),
        ({"base_position": base[:3, 3] + base[:3, 2]}, "base_position"),
    ):
        with pytest.raises(ValueRangeError, match=named):
            calibrate(recording, **keywords)
    single = as_recording(recording.position[:, :1], recording.rotation[:, :1], recording.inputs)
    with pytest.raises(ValueRangeError, match="direction"):
        calibrate(single)
    with pytest.raises(ValueRangeError, match="first_abscissa"):
        calibrate(single, direction=base[:3, 2])
    assert calibrate(single, direction=base[:3, 2], first_abscissa=0.1).abscissae.tolist() == pytest.approx([0.1])
    with pytest.raises(DataError, match="not in order"):
        calibrate(as_recording(recording.position.flip(1), recording.rotation, recording.inputs), direction=base[:3, 2])
    with pytest.raises(DataError, match="'a' was never tracked"):
        calibrate(dataclasses.replace(recording, tracked=torch.zeros(40, 3, dtype=torch.bool)))
    with pytest.raises(DataError, match="bodies"):
        poses_of(calibrate(recording), single)


def test_json_round_trip_is_exact_and_damage_is_named(tmp_path: Path) -> None:
    recording, *_ = made_up_arm()
    c, path = calibrate(recording), tmp_path / "calibration.json"
    c.save(path)
    have = RestCalibration.load(path)
    for field in dataclasses.fields(c):
        a, b = getattr(have, field.name), getattr(c, field.name)
        assert torch.equal(a, b) if isinstance(a, Tensor) else a == b
    content = json.loads(path.read_text())
    for change, message in (
        ({"version": 2}, "version 2"),
        ({"kind": "other"}, "not a calibration"),
        ({"abscissae": [0.1]}, "wrong form"),
        ({"base_position": ["x", 0, 0]}, "wrong form"),
        ({"base_position": [float("nan"), 0, 0]}, "wrong form"),
    ):
        path.write_text(json.dumps({**content, **change}))
        with pytest.raises(DataError, match=message):
            RestCalibration.load(path)
    path.write_text(json.dumps({key: value for key, value in content.items() if key != "mount_offset"}))
    with pytest.raises(DataError, match="lacks the entry 'mount_offset'"):
        RestCalibration.load(path)
    path.write_text('{"kind": ')
    with pytest.raises(DataError, match="cannot be read: "):
        RestCalibration.load(path)
    with pytest.raises(DataError, match="cannot be read"):
        RestCalibration.load(tmp_path / "none.json")


def test_the_recorded_trunk_hangs_straight(shared_data: Path) -> None:
    recording = load_recording(shared_data / "trunk", layout="trunk")
    c = calibrate(recording, direction=(0.0, -1.0, 0.0))
    assert c.rest_frames == 203
    torch.testing.assert_close(
        c.rest_lengths, torch.tensor([0.1033, 0.0941, 0.1125], dtype=torch.float64), atol=1e-4, rtol=0
    )
    assert float(torch.linalg.vector_norm(c.mount_offset, dim=-1).max()) < 0.006
    assert abs(float(c.base_position[1])) < 0.01  # the plate of the recording frame
    T = poses_of(c, recording)[:200]
    assert float(rotation_angle(torch.eye(3, dtype=T.dtype), T[..., :3, :3]).max()) < 0.06
