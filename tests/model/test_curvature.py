"""Curvature along an arm: of the models against how their frames turn, and between the middles of pieces."""

from __future__ import annotations

import pytest
import torch

from apcc_torch import Arm, ConstantStrainBackbone, PCCBackbone
from apcc_torch.errors import ConfigError, ValueRangeError
from apcc_torch.lie import so3
from apcc_torch.model.affine import AffineBackbone
from apcc_torch.model.curvature import curvature_places, curvature_weights, middle_curvature
from apcc_torch.model.kinematic_model import KinematicModel
from laws import generator, normal

D = torch.float64


@pytest.mark.parametrize(
    "model", [PCCBackbone(2), AffineBackbone(2), ConstantStrainBackbone(2)], ids=lambda m: type(m).__name__
)
def test_it_is_how_fast_a_frame_turns_along_the_curve(model: KinematicModel) -> None:
    q, L0, h = 0.02 * normal((6, model.n), D, generator(4)), torch.tensor([0.2, 0.25], dtype=D), 1e-4
    q = q + model.coordinates.from_bends(*(0.5 * normal((2, 6, 2), D, generator(5))))
    j = torch.tensor([0, 0, 1, 1])
    T = model.pose(q, L0, torch.tensor([0.5 - h, 0.5 + h] * 2, dtype=D), j)
    turn = so3.log(T[:, 0::2, :3, :3].mT @ T[:, 1::2, :3, :3])
    way = (T[:, 1::2, :3, 3] - T[:, 0::2, :3, 3]).norm(dim=-1, keepdim=True)
    want = torch.stack((turn[..., 1], -turn[..., 0]), dim=-1) / way
    torch.testing.assert_close(middle_curvature(model, q, L0), want, rtol=1e-5, atol=1e-5)


def test_what_goes_along_a_line_in_each_section_is_read_off_exactly() -> None:
    lengths, refine = torch.tensor([0.1, 0.2], dtype=D).repeat_interleave(3) / 3, 3
    middles = lengths.cumsum(0) - 0.5 * lengths
    X = torch.tensor([0.0, 0.01, 0.1, 0.100001, 0.17, 0.3], dtype=D)
    slope = torch.where(middles < 0.1, 2.0 + 5.0 * middles, -1.0 - 3.0 * middles)
    want = torch.where(X <= 0.1, 2.0 + 5.0 * X, -1.0 - 3.0 * X)
    torch.testing.assert_close(curvature_weights(lengths, refine, X) @ slope, want, rtol=0, atol=1e-12)


def test_a_section_of_one_piece_has_one_curvature_and_rows_their_own_places() -> None:
    lengths = torch.tensor([[0.1, 0.2], [0.2, 0.1]], dtype=D)
    weights = curvature_weights(lengths, 1, torch.tensor([[0.05, 0.15], [0.05, 0.25]], dtype=D))
    assert weights.tolist() == [[[1, 0], [0, 1]], [[1, 0], [0, 1]]]


def test_an_arm_says_what_its_sensors_measure() -> None:
    arm = Arm(lengths=[0.2, 0.25], sensed=["pose", "tilt"], curvature_sensors=[0.1, 0.3])
    kinds, places = arm.sensor_kinds(), curvature_places(arm)
    assert (
        kinds is not None and kinds.names == ("pose", "tilt") and places is not None and places.tolist() == [0.1, 0.3]
    )
    assert Arm(lengths=[0.2], sensed=["pose"]).sensor_kinds() is None
    with pytest.raises(ConfigError, match="a kind for each of the 2 sensors, got 1"):
        Arm(lengths=[0.2, 0.25], sensed=["pose"])
    with pytest.raises(ConfigError, match=r"sensed\[1\] must be one of pose, position, orientation, tilt"):
        Arm(lengths=[0.2, 0.25], sensed=["pose", "gyro"])
    with pytest.raises(ValueRangeError, match="curvature_sensors must lie on the arm"):
        Arm(lengths=[0.2, 0.25], curvature_sensors=[0.5])
