"""Base-frame transform against scipy's rotations and plain matrix products."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from apcc_torch.errors import HardwareError, ShapeError, ValueRangeError
from apcc_torch.hardware.mocap.frames import BaseFrame, check_pose, mean_pose, pose_distance, rotations
from hardware.optitrack.streams import settings

seeds = st.integers(0, 2**31)


def pose(rotation: Rotation, position: np.ndarray) -> np.ndarray:
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = rotation.as_matrix(), position
    return T


@given(seed=seeds, length=st.floats(0.9, 1.1))
def test_rotations_are_scipys(seed: int, length: float) -> None:
    R = Rotation.random(5, random_state=seed)
    np.testing.assert_allclose(rotations(length * R.as_quat()), R.as_matrix(), atol=1e-12)


@given(seed=seeds, up=st.sampled_from(["z", "y"]))
def test_bodies_in_the_base_frame(seed: int, up: str) -> None:
    rng = np.random.default_rng(seed)
    offset, turn = rng.normal(0, 0.05, 3), Rotation.random(random_state=seed)
    config = settings(up=up, base_offset=offset, base_quaternion=turn.as_quat())
    true = [pose(Rotation.random(random_state=rng), rng.normal(0, 2, 3)) for _ in range(4)]
    expected = [np.linalg.inv(true[0] @ pose(turn, offset)) @ T for T in true[1:]]
    # What Motive streams of these z-up poses where its up axis is y: world and body axes turned back by 90 deg about x.
    C = pose(Rotation.from_euler("x", -90 if up == "y" else 0, degrees=True), np.zeros(3))
    streamed = np.array([C @ T @ C.T for T in true])
    frame = BaseFrame(config)
    world = frame.world(streamed[:, :3, 3], Rotation.from_matrix(streamed[:, :3, :3]).as_quat())
    np.testing.assert_allclose(world, true, atol=1e-12)
    np.testing.assert_allclose(frame.relative(frame.base(world[0]), world[1:]), expected, atol=1e-12)


def test_y_up_in_motives_own_numbers() -> None:
    """Motive's z-up stream has (x, -z, y) for a y-up (x, y, z), of the position and of the quaternion alike."""
    frame = BaseFrame(settings(up="y"))
    q = Rotation.from_euler("xyz", [20, 30, 40], degrees=True).as_quat()
    T = frame.world(np.array([[1.0, 2.0, 3.0]]), q[None])[0]
    np.testing.assert_allclose(T[:3, 3], [1, -3, 2], atol=1e-12)
    np.testing.assert_allclose(T[:3, :3], Rotation.from_quat([q[0], -q[2], q[1], q[3]]).as_matrix(), atol=1e-12)


def test_the_default_base_is_20_5_mm_along_the_bodys_z() -> None:
    frame = BaseFrame(settings())
    body = pose(Rotation.from_euler("x", 90, degrees=True), np.array([1.0, 1.0, 1.0]))
    np.testing.assert_allclose(frame.base(body)[:3, 3], [1.0, 1.0 - 0.0205, 1.0], atol=1e-12)


@given(seed=seeds)
def test_pose_distance_is_scipys(seed: int) -> None:
    rng = np.random.default_rng(seed)
    a, b = (pose(Rotation.random(random_state=rng), rng.normal(size=3)) for _ in range(2))
    far, turned = pose_distance(a, b)
    expected = (Rotation.from_matrix(a[:3, :3]).inv() * Rotation.from_matrix(b[:3, :3])).magnitude()
    np.testing.assert_allclose((far, turned), (np.linalg.norm(a[:3, 3] - b[:3, 3]), expected), atol=1e-7)


@given(seed=seeds)
def test_a_base_that_stands_still_is_measured_to_its_noise(seed: int) -> None:
    rng = np.random.default_rng(seed)
    true = pose(Rotation.random(random_state=rng), rng.normal(size=3))
    shaken = np.array([true @ pose(Rotation.from_rotvec(rng.normal(0, 1e-3, 3)), np.zeros(3)) for _ in range(40)])
    shaken[:, :3, 3] += rng.normal(0, 1e-4, (40, 3))
    frame = BaseFrame(settings())
    far, turned = pose_distance(mean_pose(shaken), true)
    assert far < 2e-4 and turned < 2e-3
    np.testing.assert_allclose(frame.measure(shaken, settings()), frame.base(mean_pose(shaken)))


@pytest.mark.parametrize("what", ["position", "rotation"])
def test_a_base_that_moves_is_not_measured(what: str) -> None:
    T = np.tile(np.eye(4), (10, 1, 1))
    if what == "position":
        T[-1, 0, 3] = 0.02
    else:
        T[-1, :3, :3] = Rotation.from_rotvec([0.1, 0, 0]).as_matrix()
    with pytest.raises(HardwareError, match="'base' moved while it was measured"):
        BaseFrame(settings()).measure(T, settings())


def test_what_is_no_pose() -> None:
    check_pose("base", np.eye(4))
    with pytest.raises(ShapeError, match=r"base must have shape \(4, 4\)"):
        check_pose("base", np.eye(3))
    mirrored, stretched, lost, row = np.diag([1.0, 1.0, -1.0, 1.0]), 2 * np.eye(4), np.eye(4), np.eye(4)
    lost[0, 3], row[3, 0] = np.nan, 1.0
    for wrong in (mirrored, stretched, lost, row):
        with pytest.raises(ValueRangeError, match="base must be a pose"):
            check_pose("base", wrong)
