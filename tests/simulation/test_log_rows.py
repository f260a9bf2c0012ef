"""Rows of a log are the stack of what came, with and without gradients."""

from __future__ import annotations

import pytest
import torch

from apcc_torch.simulation.log_rows import Rows


@pytest.mark.parametrize("grad", [True, False])
def test_rows_are_a_stack(grad: bool) -> None:
    rows = [(torch.full((2, 3), float(k)), torch.tensor(k)) for k in range(4)]
    with torch.set_grad_enabled(grad):
        log = Rows(4)
        for row in rows:
            log.add(row)
        values, counts = log.stacked()
    torch.testing.assert_close(values, torch.stack([row[0] for row in rows]))
    assert counts.tolist() == [0, 1, 2, 3] and counts.dtype == torch.int64


def test_fewer_rows_than_announced() -> None:
    with torch.no_grad():
        log = Rows(5)
        log.add((torch.ones(2),))
        (values,) = log.stacked()
    assert values.shape == (1, 2)


def test_a_row_is_kept_as_it_was() -> None:
    with torch.no_grad():
        log, value = Rows(2), torch.zeros(2)
        log.add((value,))
        value += 1.0
        log.add((value,))
    assert log.stacked()[0].tolist() == [[0.0, 0.0], [1.0, 1.0]]


def test_gradients_reach_every_row() -> None:
    x = torch.tensor(2.0, requires_grad=True)
    log = Rows(3)
    for k in range(3):
        log.add((k * x,))
    log.stacked()[0].sum().backward()
    assert x.grad is not None and float(x.grad) == 3.0
