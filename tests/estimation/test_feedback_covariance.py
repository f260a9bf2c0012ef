"""How sensor noise spreads into q_bar: against the algorithm itself, nudged, and under drawn noise."""

from __future__ import annotations

import pytest
import torch

from apcc_torch import StateFeedback
from apcc_torch.estimation.feedback_covariance import feedback_covariance, feedback_response
from apcc_torch.lie import se3
from apcc_torch.model.abscissae import decouple
from apcc_torch.model.backbone import PCCBackbone
from apcc_torch.simulation.sensors import PoseSensors
from arms import HANGING_BASE, PI, configurations
from laws import generator

D = torch.float64
X = torch.tensor([0.08, 0.2, 0.36, 0.55], dtype=D)
BACKBONE = PCCBackbone(3, HANGING_BASE)


@pytest.mark.parametrize("mode", ["position", "pose"])
def test_the_response_is_the_algorithms(mode: str) -> None:
    exact = {"max_iterations": 60, "linear_threshold": 1e-13, "angular_threshold": 1e-12, "settled_step": 1e-12}
    feedback = StateFeedback(BACKBONE, X, mode, angular_weight=0.2, min_iterations=8, **exact)
    q = configurations((), 3, D, generator(1), bend=0.8)
    T = BACKBONE.pose(q, PI, *decouple(X, PI))
    h = 1e-5
    nudge = se3.exp(h * torch.eye(24, dtype=D).view(24, 4, 6))
    there, back = feedback(q, PI, T @ nudge).q_bar, feedback(q, PI, T @ se3.inverse(nudge)).q_bar
    wanted = ((there - back) / (2.0 * h)).mT.unflatten(-1, (4, 6))
    torch.testing.assert_close(feedback_response(feedback, q, PI), wanted, rtol=1e-4, atol=1e-4)


def test_the_covariance_is_the_spread() -> None:
    feedback = StateFeedback(BACKBONE, X, angular_weight=0.05, max_iterations=20)
    q = configurations((), 3, D, generator(2), bend=0.6)
    T = BACKBONE.pose(q, PI, *decouple(X, PI)).expand(3000, 4, 4, 4)
    sensors = PoseSensors(2e-4, 9e-3)
    seen = sensors(sensors.initial_state(T), T, generator(3))[1]
    spread = feedback(q, PI, seen).q_bar.mT.cov()
    stated = feedback_covariance(feedback, q, PI, 2e-4, 9e-3)
    scale = stated.diagonal().sqrt()
    torch.testing.assert_close(spread / (scale * scale[:, None]), stated / (scale * scale[:, None]), rtol=0, atol=0.1)


def test_a_sensor_left_out_says_nothing() -> None:
    feedback = StateFeedback(BACKBONE, X)
    q = configurations((), 3, D, generator(4))
    mask = torch.tensor([True, False, True, True])
    response = feedback_response(feedback, q, PI, mask)
    assert response[:, 1].abs().max() == 0.0 and response[:, 2].abs().max() > 0.0
    unturned = feedback_response(feedback, q, PI, angular_mask=mask)
    assert unturned[:, 1, :3].abs().max() == 0.0 and unturned[:, 1, 3:].abs().max() > 0.0
