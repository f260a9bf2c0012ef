"""An environment's picture: what it holds is drawn, the last one stays, and the window shows it."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
import pytest
import torch
from torch import Tensor

from apcc_torch.report.arm_scene import ArmScene
from apcc_torch.report.style import SENSOR, TARGET, TRUE, faded


class Arm(NamedTuple):
    backbone: Tensor
    tendons: Tensor
    sensors: Tensor
    goal: Tensor
    text: str


def straight(shape: bool = False, text: str = "t = 0.00 s") -> Arm:
    depth = torch.linspace(0.0, -0.6, 20)
    line = torch.stack((0.0 * depth, 0.0 * depth, depth), dim=-1)
    goal = line[::5] + 0.2 if shape else torch.tensor([0.2, 0.2, -0.4])
    return Arm(line, line.expand(3, -1, -1) + 0.03, line[[6, 12, 19]], goal, text)


def count(frame: np.ndarray[Any, Any], color: str) -> int:
    return int((np.abs(frame.astype(int) - 255 * np.array(faded(color, 1.0))) < 12).all(-1).sum())


@pytest.mark.parametrize("shape", [False, True])
def test_backbone_sensors_and_goal_are_drawn(shape: bool) -> None:
    frame = ArmScene().frame(straight(shape))
    assert frame.shape == (500, 500, 3) and frame.dtype == np.uint8
    assert min(count(frame, color) for color in (TRUE, SENSOR, TARGET)) > 20


def test_nothing_is_left_of_the_picture_before() -> None:
    scene, arm = ArmScene(), straight()
    first = scene.frame(arm)
    scene.frame(arm._replace(backbone=arm.backbone + 0.1, sensors=arm.sensors - 0.1, text="another"))
    assert (scene.frame(arm) == first).all()
