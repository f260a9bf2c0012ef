"""The covariance of a step's estimate is that of steps whose sensors are off."""

from __future__ import annotations

import pytest
import torch

from apcc_torch.control.controller import APCCController
from apcc_torch.control.estimate_covariance import SensorNoise, estimate_covariance
from apcc_torch.control.step_io import ControllerState, Measurement, Target
from apcc_torch.lie import so3
from apcc_torch.model.abscissae import decouple
from apcc_torch.model.arm import Arm

D = torch.float64
ARM = Arm(lengths=[0.2, 0.25], mass=0.4)
NOISE = SensorNoise(position=2e-3, angle=0.03)
H = 1e-5


def under_way(controller: APCCController) -> tuple[ControllerState, Measurement, Target]:
    """A controller whose estimate has settled on a bent arm."""
    L0 = ARM.rest_lengths()
    q = torch.tensor([0.3, -0.2, 0.004, 0.1, 0.4, -0.003], dtype=D)
    T = controller.backbone.pose(q, L0, *decouple(ARM.sensor_places(), L0))
    state = controller.initial_state(torch.zeros_like(q), L0, torch.zeros((), dtype=D))
    target = Target(T[-1, :3, 3], torch.zeros(3, dtype=D))
    y = controller.tendons(q, L0)
    for k in range(30):
        seen = Measurement(T, torch.tensor(0.01 * (k + 1), dtype=D), tendons=y)
        before = state
        state, _ = controller(state, seen, target)
    return before, seen, target


@pytest.mark.parametrize("mode", ["pose", "position"])
def test_it_is_that_of_sensors_that_are_off(mode: str) -> None:
    # Where no direction is unseen: of positions alone two sensors leave freedom.
    lengths = {"pose": 1.0, "position": 0.0}[mode]
    controller = APCCController.for_arm(ARM, adaptive=False, mode=mode, settled_step=0.0, max_iterations=20)
    before, seen, target = under_way(controller)
    later, _ = controller(before, seen, target)
    scatter = torch.zeros(6, 6, dtype=D)
    for k in range(2):
        for axis in torch.eye(3, dtype=D):
            for deviation, angular in ((NOISE.position, False), (NOISE.angle, True)):
                moved = []
                for sign in (H, -H):
                    T = seen.T.clone()
                    if angular:
                        T[k, :3, :3] = T[k, :3, :3] @ so3.exp(sign * axis)
                    else:
                        T[k, :3, 3] += sign * axis
                    moved.append(controller(before, seen._replace(T=T), target)[0].q_bar)
                change = float(deviation) * (moved[0] - moved[1]) / (2.0 * H)
                scatter += change.unsqueeze(-1) * change * (lengths if angular else 1.0)
    have = estimate_covariance(controller, before, later, seen, NOISE)
    torch.testing.assert_close(have, scatter, rtol=2e-3, atol=2e-3 * float(scatter.diagonal().min()))


def test_of_a_shape_it_is_the_inverse_of_what_is_known() -> None:
    controller = APCCController.for_arm(ARM)
    before, seen, target = under_way(controller)
    later, _ = controller(before, seen, target)
    have = estimate_covariance(controller, before, later, seen, NOISE)
    assert have.shape == (7, 7) and later.shape is not None and before.shape is not None
    # The estimator keeps the roots of its diagonal; those of the load, which is last, too.
    torch.testing.assert_close(have.diagonal().sqrt(), later.shape.shape.deviation, rtol=1e-9, atol=0.0)
    assert torch.linalg.eigvalsh(have).min() > 0
    blind = seen._replace(mask=torch.tensor([True, False]))
    assert (estimate_covariance(controller, before, later, blind, NOISE) - have).diagonal().min() > 0
