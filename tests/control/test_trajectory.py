"""Eq. (51) against its own derivative; set-points stand still."""

from __future__ import annotations

import math

import pytest
import torch
from torch.func import jvp

from apcc_torch.control.trajectory import SetPoint, SineTrajectory
from apcc_torch.errors import ShapeError, ValueRangeError

R_0 = torch.tensor([0.0, 0.0, -0.5], dtype=torch.float64)
A = torch.tensor([0.5, 0.3, 0.1], dtype=torch.float64)
OMEGA = 0.2 * math.pi


def test_sine() -> None:
    trajectory = SineTrajectory(R_0, A, OMEGA)
    time = torch.linspace(0.0, 20.0, 41, dtype=torch.float64)
    target = trajectory(time)
    torch.testing.assert_close(target.x_d, R_0 + A * (OMEGA * time).sin().unsqueeze(-1))
    _, rate = jvp(lambda t: trajectory(t).x_d, (time,), (torch.ones_like(time),))
    torch.testing.assert_close(target.xdot_d, rate)
    start = trajectory(torch.zeros((), dtype=torch.float64))
    assert torch.equal(start.x_d, R_0)
    torch.testing.assert_close(start.xdot_d, OMEGA * A)
    torch.testing.assert_close(trajectory(time + 10.0).x_d, target.x_d)  # one period


def test_set_point() -> None:
    points = torch.stack((R_0, A))
    target = SetPoint(points)(torch.tensor(3.0, dtype=torch.float64))
    assert torch.equal(target.x_d, points) and torch.equal(target.xdot_d, torch.zeros_like(points))
    assert SetPoint(R_0)(torch.zeros(4, dtype=torch.float64)).x_d.shape == (4, 3)


def test_dtype_follows_the_time() -> None:
    for trajectory in (SineTrajectory(R_0, A, OMEGA), SetPoint(R_0)):
        for dtype in (torch.float32, torch.float64):
            target = trajectory(torch.zeros(2, dtype=dtype))
            assert target.x_d.dtype == target.xdot_d.dtype == dtype
            assert target.x_d.shape == target.xdot_d.shape == (2, 3)


def test_refusals() -> None:
    for omega in (0.0, -1.0, math.nan, math.inf):
        with pytest.raises(ValueRangeError, match="omega must be positive"):
            SineTrajectory(R_0, A, omega)
    with pytest.raises(ValueRangeError, match="r_0 is not finite"):
        SineTrajectory(R_0 * math.nan, A, OMEGA)
    with pytest.raises(ShapeError, match="A must have shape"):
        SineTrajectory(R_0, A[:2], OMEGA)
    with pytest.raises(ValueRangeError, match="x_d is not finite"):
        SetPoint(R_0 * math.inf)
