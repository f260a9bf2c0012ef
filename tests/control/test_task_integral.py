"""Integral action against the closed form of a double integrator, far from the target, and with nonsense."""

from __future__ import annotations

import math

import pytest
import torch

from apcc_torch.control.task_integral import TaskIntegral
from apcc_torch.errors import ValueRangeError
from laws import generator, normal


def test_it_takes_over_a_constant_disturbance() -> None:
    """edot = -K (e + z) + v: e goes to 0 as s^2 + K s + K gain says, z to v / K."""
    K, gain, dt, time = 1.8, 0.3, 1e-3, 4.0
    v = torch.tensor([1e-4, -2e-4, 5e-5], dtype=torch.float64)
    integral = TaskIntegral(gain, reach=1.0)
    e = z = torch.zeros(3, dtype=torch.float64)
    for _ in range(round(time / dt)):
        z = integral(z, e, torch.tensor(dt, dtype=torch.float64))
        e = e + dt * (v - K * (e + z))
    root = math.sqrt(K * K / 4 - K * gain)
    closed = v / root * math.exp(-K * time / 2) * math.sinh(root * time)
    torch.testing.assert_close(e, closed, rtol=0, atol=1e-7)
    torch.testing.assert_close(z, v / K, rtol=0.5, atol=0)


def test_a_large_error_winds_nothing_up() -> None:
    integral = TaskIntegral(1.0, reach=1e-3)
    second = torch.ones((), dtype=torch.float64)
    near, far = (integral(torch.zeros(3), torch.tensor([e, 0.0, 0.0]), second)[0] for e in (1e-4, 0.5))
    assert float(near) == pytest.approx(1e-4, rel=1e-3)
    assert float(far) < 1e-10


def test_a_row_has_its_own_numbers_and_its_own_nonsense() -> None:
    gain, reach = torch.tensor([0.0, 0.5, 1.0]), torch.tensor([1e-3, 2e-3, 1e-2])
    e, z = 1e-3 * normal((3, 3), torch.float32, generator(0)), 1e-4 * normal((3, 3), torch.float32, generator(1))
    dt = torch.full((3,), 0.02)
    every = TaskIntegral(gain, reach)(z, e, dt)
    for row in range(3):
        one = TaskIntegral(float(gain[row]), float(reach[row]))(z[row], e[row], dt[row])
        torch.testing.assert_close(every[row], one)
    e[1, 2] = torch.nan
    bad = TaskIntegral(gain, reach)(z, e, dt)
    assert torch.equal(bad[[0, 2]], every[[0, 2]])
    assert torch.equal(bad[1], z[1])


@pytest.mark.parametrize(("name", "value"), [("gain", -1.0), ("reach", 0.0)])
def test_bad_settings(name: str, value: float) -> None:
    with pytest.raises(ValueRangeError, match=f"^{name} must be"):
        TaskIntegral(**{name: value})
