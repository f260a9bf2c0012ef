"""The causal Savitzky-Golay filter against scipy's coefficients, polynomials, and numpy's least squares."""

from __future__ import annotations

from contextlib import nullcontext

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from scipy.signal import savgol_coeffs
from torch import Tensor

from apcc_torch.errors import ApccError, DtypeError, ShapeError, ValueRangeError
from apcc_torch.estimation.savitzky_golay import SavitzkyGolay, SavitzkyGolayState
from laws import check_bad_row, check_batching, check_gradients, generator, normal, uniform


def feed(
    f: SavitzkyGolay, samples: Tensor, times: Tensor, valid: Tensor | None = None
) -> tuple[SavitzkyGolayState, Tensor]:
    """All samples (T, ..., n) in turn; the last state and the derivatives (T, ..., n)."""
    state, rates = f.initial_state(samples[0], times[0]), []
    for i in range(len(samples)):
        state, rate = f(state, samples[i], times[i], None if valid is None else valid[i])
        rates.append(rate)
    return state, torch.stack(rates)


def fitted(times: np.ndarray, samples: np.ndarray, order: int, derivative: int, at: float) -> np.ndarray:
    """The oracle: numpy's least squares on one window."""
    span = np.ptp(times) or 1.0
    p = np.polynomial.polynomial.polyfit((times - at) / span, samples, min(order, len(times) - 1))
    return np.polynomial.polynomial.polyval(0.0, np.polynomial.polynomial.polyder(p, derivative)) / span**derivative


def stamps(n: int, seed: int) -> Tensor:
    return torch.cumsum(uniform((n,), 1e-3, 2e-2, torch.float64, generator(seed)), 0)


CASES = [(5, 2, 1), (15, 2, 1), (25, 3, 1), (45, 2, 1), (25, 4, 2), (9, 1, 1), (7, 3, 0), (5, 4, 1)]


@pytest.mark.parametrize("period", [None, 0.002])
@pytest.mark.parametrize(("window", "order", "derivative"), CASES)
def test_a_full_even_buffer_has_scipys_coefficients(
    window: int, order: int, derivative: int, period: float | None
) -> None:
    f = SavitzkyGolay(window, order, derivative, period=period)
    # One unit sample at each place of the buffer, as a batch of signals.
    _, rates = feed(f, torch.eye(window, dtype=torch.float64), 0.002 * torch.arange(window, dtype=torch.float64))
    want = savgol_coeffs(window, order, deriv=derivative, delta=0.002, pos=window - 1, use="dot")
    assert np.abs(rates[-1].numpy() - want).max() <= 1e-9 * np.abs(want).max()


@given(st.integers(0, 4), st.integers(0, 10), st.integers(0, 2), st.integers(0, 10_000))
def test_polynomials_are_differentiated_exactly_at_uneven_stamps(
    order: int, extra: int, derivative: int, seed: int
) -> None:
    derivative = min(derivative, order)
    f = SavitzkyGolay(order + 1 + extra, order, derivative)
    times = stamps(30, seed)
    coefficients = normal((order + 1, 2), torch.float64, generator(seed + 1)).numpy()
    values = np.polynomial.polynomial.polyval(times.numpy(), coefficients, tensor=True).T
    want = np.polynomial.polynomial.polyval(
        times.numpy(), np.polynomial.polynomial.polyder(coefficients, derivative), tensor=True
    ).T
    state, rates = feed(f, torch.from_numpy(values), times)
    scale = np.abs(values).max() * (1 + order**2 / 1e-2) ** derivative
    assert np.abs(rates.numpy() - want)[order:].max() <= 1e-8 * scale
    fit = f.evaluate(state)
    assert np.abs(fit.value.numpy() - values[-1]).max() <= 1e-9 * scale
    assert torch.equal(fit.derivative, rates[-1])


@given(st.integers(1, 3), st.integers(0, 10_000))
def test_missing_samples_are_left_out_and_the_fit_is_read_at_the_given_stamp(order: int, seed: int) -> None:
    window, f = 12, SavitzkyGolay(12, order)
    rng = generator(seed)
    times, samples = stamps(40, seed), normal((40, 3), torch.float64, rng)
    valid = uniform((40,), 0.0, 1.0, torch.float64, rng) > 0.4
    _, rates = feed(f, samples, times, valid)
    for i in range(40):
        used = [k for k in range(max(0, i - window + 1), i + 1) if valid[k]]
        if not used:
            assert torch.equal(rates[i], torch.zeros_like(rates[i]))
            continue
        want = fitted(times[used].numpy(), samples[used].numpy(), order, 1, float(times[i]))
        np.testing.assert_allclose(rates[i].numpy(), want, rtol=1e-6, atol=1e-6 * np.abs(want).max() + 1e-9)


@pytest.mark.parametrize("period", [None, 0.01])
def test_the_order_rises_from_zero_at_the_start(period: float | None) -> None:
    times = 0.01 * torch.arange(8, dtype=torch.float64)
    samples = normal((8, 2), torch.float64, generator())
    state, rates = feed(SavitzkyGolay(6, 3, period=period), samples, times)
    assert torch.equal(rates[0], torch.zeros_like(rates[0]))
    torch.testing.assert_close(rates[1], (samples[1] - samples[0]) / 0.01)
    for i in range(1, 8):
        lo = max(0, i - 5)
        want = fitted(times[lo : i + 1].numpy(), samples[lo : i + 1].numpy(), 3, 1, float(times[i]))
        np.testing.assert_allclose(rates[i].numpy(), want, rtol=1e-9)
    assert state.samples.shape == (6, 2) and bool(state.valid.all())


def test_repeated_stamps_give_finite_rates() -> None:
    times = torch.tensor([0.0, 0.0, 0.0, 0.01, 0.01, 0.02, 0.02], dtype=torch.float64)
    samples = 3 * times.unsqueeze(-1) + torch.tensor([[1.0, 2.0]], dtype=torch.float64)
    _, rates = feed(SavitzkyGolay(5, 2), samples, times)
    assert torch.equal(rates[:3], torch.zeros_like(rates[:3]))
    torch.testing.assert_close(rates[3:], torch.full_like(rates[3:], 3.0))


@pytest.mark.parametrize("period", [None, 0.01])
@pytest.mark.parametrize("bad", [torch.nan, torch.inf])
def test_a_sample_that_is_not_finite_counts_as_missing(bad: float, period: float | None) -> None:
    times = 0.01 * torch.arange(20, dtype=torch.float64)
    samples = torch.sin(20 * times).unsqueeze(-1).repeat(1, 2)
    harmed, valid = samples.clone(), torch.ones(20, dtype=torch.bool)
    harmed[7, 1], valid[7] = bad, False
    harmed[0, 0], valid[0] = bad, False
    f = SavitzkyGolay(6, 2, period=period)
    _, rates = feed(f, harmed, times)
    assert torch.equal(rates, feed(f, samples, times, valid)[1])
    assert bool(rates.isfinite().all())
    assert torch.equal(rates[13:], feed(f, samples, times)[1][13:]) or period is None
    torch.testing.assert_close(rates[13:], feed(f, samples, times)[1][13:])


def test_with_a_period_a_missing_sample_is_held() -> None:
    f = SavitzkyGolay(5, 2, period=0.01)
    times, samples = 0.01 * torch.arange(9, dtype=torch.float64), normal((9, 2), torch.float64, generator())
    held, valid = samples.clone(), torch.ones(9, dtype=torch.bool)
    held[4], valid[4] = held[3], False
    assert torch.equal(feed(f, samples, times, valid)[1], feed(f, held, times)[1])


def test_float32_stays_accurate_at_large_stamps() -> None:
    times = 1e5 + 0.002 * torch.arange(60, dtype=torch.float64)
    samples = torch.sin(3 * (times - 1e5)).unsqueeze(-1)
    for f in (SavitzkyGolay(25, 2), SavitzkyGolay(25, 2, period=0.002)):
        _, want = feed(f, samples, times)
        _, have = feed(f, samples.float(), times)
        assert have.dtype == torch.float32
        torch.testing.assert_close(have.double(), want, rtol=0, atol=2e-4)


@pytest.mark.parametrize("period", [None, 0.01])
def test_batching(period: float | None) -> None:
    f = SavitzkyGolay(6, 2, period=period)

    def op(samples: Tensor, steps: Tensor) -> tuple[Tensor, Tensor]:
        """Samples (..., 9, 2) and steps (..., 9) in turn."""
        times = steps.cumsum(-1)
        state = f.initial_state(samples[..., 0, :], times[..., 0])
        rate = samples[..., 0, :]
        for i in range(9):
            state, rate = f(state, samples[..., i, :], times[..., i])
        fit = f.evaluate(state)
        return rate, fit.value

    def make(shape: tuple[int, ...], dtype: torch.dtype, rng: torch.Generator) -> tuple[Tensor, Tensor]:
        return normal((*shape, 9, 2), dtype, rng), uniform((*shape, 9), 0.5, 1.5, dtype, rng)

    check_batching(op, make, shared=(1,), scale=20.0)
    check_bad_row(op, make((4,), torch.float64, generator()))


def test_one_clock_serves_a_batch() -> None:
    f = SavitzkyGolay(5, 2)
    samples, times = normal((7, 3, 2), torch.float64, generator()), stamps(7, 0)
    shared = feed(f, samples, times)[1]
    torch.testing.assert_close(shared, feed(f, samples, times.unsqueeze(-1).expand(7, 3))[1])
    state = f.initial_state(samples[0, 0], times[0].expand(3))
    assert state.samples.shape == (3, 5, 2)
    state, rate = f(state, samples[0, 0], times[0])
    assert rate.shape == (3, 2) and state.valid.shape == (3, 5)


@pytest.mark.parametrize("count", [1, 2, 3, 8])
def test_gradients(count: int) -> None:
    f, times = SavitzkyGolay(5, 2), stamps(8, 1)

    def op(samples: Tensor) -> tuple[Tensor, Tensor]:
        state, rates = feed(f, samples, times[:count])
        return rates, f.evaluate(state).value

    check_gradients(op, normal((count, 2), torch.float64, generator()), second=False)
    # A missing NaN sample gives a zero gradient, not NaN.
    samples = normal((count, 2), torch.float64, generator()).requires_grad_()
    mask = torch.zeros(count, 1, dtype=torch.bool)
    mask[-1] = True
    op(samples.masked_fill(mask, torch.nan))[0].sum().backward()
    assert samples.grad is not None and bool(samples.grad.isfinite().all())


@pytest.mark.parametrize(("dtype", "coarse"), [(torch.float32, True), (torch.float64, False)])
def test_stamps_that_cannot_tell_a_period_are_refused_at_the_start_and_warned_of_later(
    dtype: torch.dtype, coarse: bool
) -> None:
    f, epoch, sample = SavitzkyGolay(5, 2), torch.tensor(1.7e9, dtype=dtype), torch.zeros(2, dtype=torch.float32)
    fault = "time is torch.float32, which has steps of 128 s at 1.7e[+]09 s; hand in float64"
    with pytest.raises(ValueRangeError, match=fault) if coarse else nullcontext():
        f.initial_state(sample, epoch)
    state = f.initial_state(sample, torch.tensor(0.0, dtype=dtype))
    with pytest.warns(UserWarning, match=fault) if coarse else nullcontext():
        f(state, sample, epoch)
    f(state, sample, torch.tensor(3600.0, dtype=dtype))  # an hour is told well enough


def test_gradient_in_the_stamps() -> None:
    samples = normal((6, 2), torch.float64, generator())
    check_gradients(lambda times: feed(SavitzkyGolay(5, 2), samples, times)[1], stamps(6, 3), second=False)


@pytest.mark.parametrize(
    ("arguments", "named"),
    [
        ((2, 2), "window"),
        ((5, 0), "order"),
        ((5, 1, 2), "order"),
        ((5, 2, -1), "derivative"),
        ((5, 2, 1, 0.0), "period"),
        ((5, 2, 1, float("nan")), "period"),
    ],
)
def test_bad_settings_are_named(arguments: tuple[float, ...], named: str) -> None:
    with pytest.raises(ValueRangeError, match=f"^{named} must"):
        SavitzkyGolay(*arguments)


def test_bad_input_is_named() -> None:
    f, zero = SavitzkyGolay(5, 2), torch.zeros((), dtype=torch.float64)
    state = f.initial_state(torch.zeros(3, dtype=torch.float64), zero)
    with pytest.raises(ShapeError, match="sample"):
        f(state, torch.zeros(2, dtype=torch.float64), zero)
    with pytest.raises(DtypeError, match="time"):
        f(state, torch.zeros(3, dtype=torch.float64), 0.0)
    with pytest.raises(ApccError, match=r"sample.*float32"):
        f(state, torch.zeros(3), zero)
    with pytest.raises(ShapeError, match="time"):
        f(state, torch.zeros(3, dtype=torch.float64), torch.zeros(2, dtype=torch.float64))
