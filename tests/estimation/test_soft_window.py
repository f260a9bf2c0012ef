"""The soft window: Savitzky-Golay where all weights are one, weighted least squares elsewhere, with gradients."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor

from apcc_torch.errors import ValueRangeError
from apcc_torch.estimation.savitzky_golay import SavitzkyGolay, SavitzkyGolayState
from apcc_torch.estimation.soft_window import SoftWindow
from laws import check_gradients, generator, normal, uniform

D = torch.float64


def fed(window: SavitzkyGolay, samples: Tensor, times: Tensor) -> Tensor:
    """Derivatives (T, n) at each of samples (T, n)."""
    state: SavitzkyGolayState = window.initial_state(samples[0], times[0])
    found = []
    for sample, time in zip(samples, times, strict=True):
        state, derivative = window(state, sample, time)
        found.append(derivative)
    return torch.stack(found)


def series(count: int) -> tuple[Tensor, Tensor]:
    """Samples (count, 2), one of them missing, at uneven times."""
    rng = generator(0)
    samples, times = normal((count, 2), D, rng), uniform((count,), 0.01, 0.03, D, rng).cumsum(0)
    samples[4] = torch.nan
    return samples, times


@pytest.mark.parametrize("derivative", [1, 2])
def test_equal_weights_are_savitzky_golay(derivative: int) -> None:
    samples, times = series(12)
    want = fed(SavitzkyGolay(7, 3, derivative), samples, times)
    for size in (1.0, 0.2):
        have = fed(SoftWindow(torch.full((7,), size, dtype=D), 3, derivative), samples, times)
        torch.testing.assert_close(have, want, rtol=1e-9, atol=1e-9)


def test_weights_are_those_of_least_squares() -> None:
    samples, times = series(12)
    weights = uniform((6,), 0.05, 1.0, D, generator(1))
    have = fed(SoftWindow(weights, 2), samples, times)[-1]
    t = times[-6:] - times[-1]
    powers = torch.stack((torch.ones_like(t), t, t * t), dim=-1)
    root = weights.sqrt().unsqueeze(-1)
    want = torch.linalg.lstsq(root * powers, root * samples[-6:]).solution[1]
    torch.testing.assert_close(have, want, rtol=1e-9, atol=1e-9)


def test_it_is_exact_on_polynomials_whatever_the_weights() -> None:
    times = series(10)[1]
    samples = torch.stack((3.0 + 0.0 * times, 1.0 - 2.0 * times + 5.0 * times.square()), dim=-1)
    have = fed(SoftWindow(uniform((5,), 0.01, 1.0, D, generator(2)), 2), samples, times)
    want = torch.stack((0.0 * times, -2.0 + 10.0 * times), dim=-1)
    torch.testing.assert_close(have[2:], want[2:], rtol=0, atol=1e-9)


def test_gradients() -> None:
    samples, times = series(9)
    logarithms = normal((5,), D, generator(3))
    check_gradients(lambda log: fed(SoftWindow(log.exp(), 2), samples, times)[[3, 8]], logarithms, second=False)


def test_refusals() -> None:
    with pytest.raises(ValueRangeError, match="weights must be positive"):
        SoftWindow(torch.tensor([1.0, 0.0, 1.0]), 1)
    with pytest.raises(ValueRangeError, match="digits"):
        SoftWindow(torch.tensor([1e-9, 1.0, 1.0]), 1)
    with pytest.raises(ValueRangeError, match="window must be at least"):
        SoftWindow(torch.ones(2), 2)
