"""Small systems against the library's general routines."""

from __future__ import annotations

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor

from apcc_torch.linalg import inverse_spd3, scaled_within, solve_spd, solve_spd_unrolled
from laws import bits, generator, normal, seeds

D = torch.float64


@given(n=st.integers(1, 6), m=st.integers(1, 4), shape=st.sampled_from(((), (1,), (2, 3))), seed=seeds)
@settings(deadline=None, max_examples=40)
def test_written_out_elimination(n: int, m: int, shape: tuple[int, ...], seed: int) -> None:
    half, B = normal((*shape, n, n), D, generator(seed)), normal((*shape, n, m), D, generator(seed + 1))
    A = half @ half.mT + 0.1 * torch.eye(n, dtype=D)
    torch.testing.assert_close(solve_spd_unrolled(A, B), torch.linalg.solve(A, B), rtol=1e-8, atol=1e-8)
    one = B[(0,) * len(shape)]
    torch.testing.assert_close(solve_spd_unrolled(A, one), torch.linalg.solve(A, one.expand_as(B)))


def test_large_batches_of_small_systems_are_written_out() -> None:
    half, B = normal((300, 3, 3), D, generator(0)), normal((300, 3, 9), D, generator(1))
    A = half @ half.mT + 0.1 * torch.eye(3, dtype=D)
    A[7] = -A[7]
    have = solve_spd(A, B)
    good = torch.arange(300) != 7
    assert have[7].isnan().all() and torch.equal(have[good], solve_spd_unrolled(A, B)[good])
    torch.testing.assert_close(have[good], torch.linalg.solve(A[good], B[good]), rtol=1e-8, atol=1e-8)


def test_gradient_of_the_written_out_elimination() -> None:
    half, B = normal((3, 3), D, generator(3)).requires_grad_(), normal((3, 2), D, generator(4)).requires_grad_()
    eye = torch.eye(3, dtype=D)
    assert torch.autograd.gradcheck(lambda h, b: solve_spd_unrolled(h @ h.mT + eye, b), (half, B))


@given(seed=seeds)
@settings(deadline=None, max_examples=25)
def test_inverse_spd3(seed: int) -> None:
    half = normal((5, 3, 3), D, generator(seed))
    A = half @ half.mT + 0.01 * torch.eye(3, dtype=D)
    inverse = inverse_spd3(A)
    torch.testing.assert_close(inverse, inverse.mT, rtol=0, atol=0)
    torch.testing.assert_close(inverse, torch.linalg.inv(A), rtol=1e-8, atol=1e-8)


def test_inverse_spd3_of_an_indefinite_matrix_is_nan() -> None:
    A = torch.diag_embed(torch.tensor([[1.0, 2.0, 3.0], [1.0, -2.0, 3.0], [1.0, 2.0, -3.0]], dtype=D))
    bad = inverse_spd3(A).isnan().flatten(-2).any(-1)
    assert torch.equal(bad, torch.tensor([False, True, True]))


def test_inverse_spd3_gradient() -> None:
    half = normal((3, 3), D, generator(3)).requires_grad_()
    assert torch.autograd.gradcheck(lambda h: inverse_spd3(h @ h.mT + torch.eye(3, dtype=D)), half)


def rows(*values: float) -> Tensor:
    return torch.tensor(values, dtype=D)


@given(seed=seeds, bound=st.floats(1e-3, 1e3))
def test_a_scaled_row_keeps_its_direction(seed: int, bound: float) -> None:
    x = 10.0 * normal((4, 3), D, generator(seed))
    found = scaled_within(x, bound)
    for row, got in zip(x.tolist(), found.tolist(), strict=True):
        largest = max(abs(value) for value in row)
        want = row if largest <= bound else [value * bound / largest for value in row]
        assert got == pytest.approx(want, rel=1e-12, abs=0.0)


def test_each_row_is_scaled_by_its_own_bound() -> None:
    x = rows(-4.0, 0.5, 2.0).expand(3, 3)
    found = scaled_within(x, rows(4.0, 2.0, 0.4))
    torch.testing.assert_close(found, x * rows(1.0, 0.5, 0.1).unsqueeze(-1))
    # What is within its bound is left as it is, zero too.
    assert torch.equal(bits(found[0]), bits(x[0])) and not bool(scaled_within(0.0 * x, 1.0).any())
    assert scaled_within(x, None) is x


def test_a_bad_row_stays_alone() -> None:
    x = torch.stack((rows(1.0, 2.0), rows(torch.nan, 1.0), rows(torch.inf, 1.0), rows(3.0, 0.0)))
    alone = scaled_within(x[[0, 3]], 1.0)
    assert torch.equal(bits(scaled_within(x, 1.0)[[0, 3]]), bits(alone))


def test_some_entries_alone_may_be_bounded() -> None:
    x = rows(-4.0, 0.5, 9.0)
    assert scaled_within(x, 1.0, of=x[:2]).tolist() == [-1.0, 0.125, 2.25]
