"""Bounds on vectors: entry by entry, and of a row as a whole."""

from __future__ import annotations

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from torch import Tensor

from apcc_torch.control.bounds import scaled_within, within
from laws import bits, generator, normal, seeds

D = torch.float64


def rows(*values: float) -> Tensor:
    return torch.tensor(values, dtype=D)


def test_within_holds_each_row_to_its_bound() -> None:
    x = rows(-2.0, 0.5, 2.0).expand(2, 3)
    assert within(x, rows(1.0, 0.1)).tolist() == [[-1.0, 0.5, 1.0], [-0.1, 0.1, 0.1]]
    assert within(x, 1.0).tolist() == [[-1.0, 0.5, 1.0]] * 2
    assert within(x, None) is x


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
