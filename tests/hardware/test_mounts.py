"""Mounts between tracked bodies and the model's frames, against poses composed by matrices."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from apcc_torch.errors import SafetyError, ShapeError
from apcc_torch.hardware.calibration_measurement import rest_calibration
from apcc_torch.hardware.interfaces import PoseSample
from apcc_torch.hardware.mounts import Mounts
from apcc_torch.lie import so3
from fake_runs import builder, rest, sensing

ALL = np.ones(3, dtype=np.bool_)
NAMES = ("disk_1", "disk_3", "disk_5")


def frames_of_bodies(seed: int = 0) -> np.ndarray:
    """(3, 4, 4) the model's frames in bodies that sit anyhow, up to 10 mm beside the arm's axis and along it."""
    generator = torch.Generator().manual_seed(seed)
    T = torch.eye(4, dtype=torch.float64).repeat(3, 1, 1)
    T[:, :3, :3] = so3.exp(2.0 * torch.rand(3, 3, generator=generator, dtype=torch.float64) - 1.0)
    T[:, :3, 3] = 0.01 * torch.rand(3, 3, generator=generator, dtype=torch.float64)
    return T.numpy()


def hanging(bodies: np.ndarray, frames: int = 20) -> np.ndarray:
    """(N, 3, 4, 4) poses of the bodies on the resting arm, with a little noise."""
    T = np.repeat((rest() @ np.linalg.inv(bodies))[None], frames, axis=0)
    T[..., :3, 3] += 1e-5 * np.random.default_rng(0).standard_normal((frames, 3, 3))
    return T


def test_a_calibrated_arm_is_seen_where_the_model_has_it() -> None:
    """The true mount's part along the arm is not to be known; it makes the abscissa. All else is found."""
    bodies = frames_of_bodies()
    found = rest_calibration(NAMES, hanging(bodies), builder().base_rotation(), 1e-3)
    mounts = Mounts.of(found)
    T = hanging(bodies, 1)[0]
    turned = mounts.turned(T)
    place = mounts.moved(turned[:, :3, :3], turned[:, :3, 3])
    straight = found.abscissae.numpy()[:, None] * np.array([0.0, 0.0, -1.0])
    assert np.abs(place - straight).max() < 1e-4
    assert np.abs(turned[:, :3, :3] - rest()[:, :3, :3]).max() < 1e-9
    assert np.abs(found.abscissae.numpy() - builder().sensors_at().numpy()).max() < 0.02


def test_a_position_keeps_the_held_rotation_where_the_rotation_is_gated() -> None:
    """Markers swapped within a body: its rotation is turned by half a turn, its position is right."""
    bodies = frames_of_bodies(1)
    mounts = Mounts.of(rest_calibration(NAMES, hanging(bodies), builder().base_rotation(), 1e-3))
    sense = sensing(mounts)
    T = hanging(bodies, 1)[0]
    first = sense.look(PoseSample(0.01, 1, T, ALL), 0.011)
    swapped = T.copy()
    swapped[1, :3, :3] = T[1, :3, :3] @ np.diag([-1.0, 1.0, -1.0])
    swapped[:, 0, 3] += 1e-4
    second = sense.look(PoseSample(0.02, 2, swapped, ALL), 0.021)
    assert first is not None and first.complete and second is not None
    assert second.position_ok.all() and not second.orientation_ok[1]
    assert np.allclose(second.T[:, :3, 3] - first.T[:, :3, 3], [1e-4, 0.0, 0.0], atol=1e-12)


def test_samples_that_cannot_be_written_to_are_taken() -> None:
    T, valid = rest().copy(), ALL.copy()
    T.setflags(write=False)
    valid.setflags(write=False)
    frame = sensing().look(PoseSample(0.01, 1, T, valid), 0.011)
    assert frame is not None and frame.complete


def test_an_arm_that_moves_or_hangs_upside_down_is_refused() -> None:
    T = hanging(frames_of_bodies())
    T[10, 2, :3, 3] += 0.01
    with pytest.raises(SafetyError, match=r"disk_5 moved by 17\.\d mm"):
        rest_calibration(NAMES, T, builder().base_rotation(), 2e-3)
    with pytest.raises(SafetyError, match="not in order along the arm"):
        rest_calibration(NAMES, hanging(frames_of_bodies())[:, ::-1].copy(), builder().base_rotation(), 2e-3)
    with pytest.raises(ShapeError, match="mounts must be"):
        Mounts(np.zeros((2, 3, 3)), np.zeros((3, 3)))
