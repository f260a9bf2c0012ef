"""A small made-up run that the tests of the figures draw."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor

from apcc_torch.model.backbone import HANGING, PCCBackbone
from apcc_torch.report.backbone_drawing import Snapshots, marker_positions
from apcc_torch.simulation.kinematic import KinematicLog


@pytest.fixture
def arm() -> PCCBackbone:
    return PCCBackbone(3, torch.tensor(HANGING, dtype=torch.float64))


@pytest.fixture
def pi() -> Tensor:
    return torch.tensor([0.105, 0.255, 0.24], dtype=torch.float64)


@pytest.fixture
def abscissae() -> Tensor:
    return torch.tensor([0.105, 0.36, 0.6], dtype=torch.float64)


@pytest.fixture
def log(arm: PCCBackbone, pi: Tensor) -> KinematicLog:
    """An arm that bends more and more, and a model that comes to fit it: 41 moments over 4 s."""
    time = torch.linspace(0.0, 4.0, 41, dtype=torch.float64)
    share = (time / 4.0).unsqueeze(-1)
    q_true = share * torch.tensor([0.5, 0.2, 0.01, 0.6, -0.1, 0.02, 0.3, 0.4, -0.01], dtype=torch.float64)
    pi_hat = pi + (1.0 - share) * torch.tensor([0.015, 0.025, 0.03], dtype=torch.float64)
    q_bar = q_true + 0.05 * (1.0 - share)
    x = arm.tip(q_true, pi)
    error = (1.0 - share) * torch.tensor([0.01, 0.02, 0.03], dtype=torch.float64)
    return KinematicLog(time, x + 0.01 * share, x, q_true, q_bar, pi_hat, error, 2 * error, torch.zeros(41).long())


@pytest.fixture
def moments(arm: PCCBackbone, pi: Tensor, abscissae: Tensor, log: KinematicLog) -> Snapshots:
    """Every moment of `log`; the target moves."""
    return Snapshots(
        log.time,
        arm.points(log.q_true, pi, 30),
        arm.points(log.q_bar, log.pi_hat, 25),
        marker_positions(arm, log.q_true, pi, abscissae),
        marker_positions(arm, log.q_bar, log.pi_hat, abscissae),
        log.x_d,
    )
