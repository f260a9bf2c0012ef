"""Stumpff functions against fifty-digit arithmetic and their own differential equation."""

from __future__ import annotations

from math import factorial

import mpmath
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from apcc_torch.lie.stumpff import stumpff, stumpff_c7
from laws import FLOATS, check_bad_row, check_batching, check_gradients, generator, uniform

# The straight pose, the seam between series and closed form, multiples of half a turn, far beyond any arc.
GRID = [0.0, 1e-300, 1e-30, 1e-16, 1e-8, 1e-4, 0.01, 0.3, 1.0, 2.5, 3.9, 3.9999, 4.0, 4.0001, 4.1, 5.0, 7.0]
GRID += [9.0, 9.8696, 9.87, 12.0, 20.0, 30.0, 39.4784, 39.5, 50.0, 60.0]


def reference(m: int, x: float) -> float:
    with mpmath.workdps(50):
        value = mpmath.nsum(lambda k: (-mpmath.mpf(x)) ** k / mpmath.factorial(2 * k + m), [0, 60])
        return float(value)


@pytest.mark.parametrize("dtype", FLOATS)
def test_values_match_fifty_digits(dtype: torch.dtype) -> None:
    x = torch.tensor(GRID, dtype=dtype)
    eps = torch.finfo(dtype).eps
    for m, c in enumerate(stumpff(x)):
        want = torch.tensor([reference(m, v) for v in x.tolist()], dtype=torch.float64)
        error = (c.double() - want).abs()
        # c_0 and c_1 pass through zero, where only the absolute error means anything; the rest stay positive, and
        # full relative precision is asked of them wherever they are not about to vanish.
        floor = 1.0 / factorial(m) if m < 2 else 0.02 / factorial(m)
        assert (error / want.abs().clamp_min(floor)).max() < 60.0 * eps, f"c_{m}"


@given(x=st.floats(0.0, 60.0))
def test_values_match_fifty_digits_anywhere(x: float) -> None:
    for m, c in enumerate(stumpff(torch.tensor(x, dtype=torch.float64))):
        assert abs(c.item() - reference(m, x)) < 2e-15 / factorial(max(m - 1, 0)), f"c_{m}"


@given(x=st.floats(0.0, 60.0))
def test_c7_matches_fifty_digits_anywhere(x: float) -> None:
    at = torch.tensor(x, dtype=torch.float64)
    assert abs(stumpff_c7(at, stumpff(at).c5).item() - reference(7, x)) < 2e-15 / factorial(6)


def test_zero_is_the_inverse_factorial() -> None:
    for m, c in enumerate(stumpff(torch.zeros(()))):
        assert c.item() == pytest.approx(1.0 / factorial(m), rel=1e-7)


@pytest.mark.parametrize("x", [0.0, 1e-12, 1e-3, 1.0, 3.99, 4.01, 15.0, 45.0])
def test_derivatives_are_stumpff_functions(x: float) -> None:
    at = torch.tensor(x, dtype=torch.float64, requires_grad=True)
    c = stumpff(at)
    for m in range(5):
        (first,) = torch.autograd.grad(c[m], at, create_graph=True)
        torch.testing.assert_close(first, 0.5 * (m * c[m + 2] - c[m + 1]), rtol=1e-11, atol=1e-13)
        if m < 3:
            (second,) = torch.autograd.grad(first, at, retain_graph=True)

            # c_m'' from the same identity, used twice.
            def slope(k: int) -> torch.Tensor:
                return 0.5 * (k * c[k + 2] - c[k + 1])

            torch.testing.assert_close(second, 0.5 * (m * slope(m + 2) - slope(m + 1)), rtol=1e-9, atol=1e-12)


def test_no_branch_spoils_the_derivatives_of_the_other() -> None:
    # Far beyond the seam the powers of the series overflow float32; their derivatives must not reach the result.
    x = torch.tensor([1e5, 1e20], requires_grad=True)
    for c in stumpff(x):
        (slope,) = torch.autograd.grad(c.sum(), x, create_graph=True)
        assert slope.isfinite().all()


def test_highest_derivatives_at_zero() -> None:
    for m in range(7):
        at = torch.zeros((), dtype=torch.float64, requires_grad=True)
        (first,) = torch.autograd.grad(stumpff(at)[m], at, create_graph=True)
        (second,) = torch.autograd.grad(first, at)
        assert first.item() == pytest.approx(-1.0 / factorial(m + 2), rel=1e-14)
        assert second.item() == pytest.approx(2.0 / factorial(m + 4), rel=1e-14)


def test_gradients_match_finite_differences() -> None:
    check_gradients(stumpff, torch.tensor([0.5, 3.0, 6.0, 30.0]))


def test_laws() -> None:
    check_batching(stumpff, lambda shape, dtype, rng: (uniform(shape, 0.0, 20.0, dtype, rng),))
    check_bad_row(stumpff, (uniform((4,), 0.0, 20.0, torch.float32, generator()),))
