"""Intervals from whole movements left out: against fits without them, Student's table, and errors of known making."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor

from apcc_torch.identification.left_out import (
    STRETCHES,
    left_out,
    leverage,
    margins,
    movements_of,
    student_95,
)
from laws import generator, normal

D = torch.float64


def linear(J: Tensor, y: Tensor, size: float, kept: Tensor) -> Tensor:
    """Scores (P,) of a ridge regression on some of the samples, by numpy's least squares of stacked rows."""
    rows = torch.cat((J[kept].flatten(0, 1) / size, torch.eye(J.shape[-1], dtype=D)))
    wanted = torch.cat((y[kept].flatten() / size, torch.zeros(J.shape[-1], dtype=D)))
    return torch.linalg.lstsq(rows, wanted).solution


def test_a_movement_left_out_is_a_fit_without_it() -> None:
    rng = generator(0)
    J, size, movement = normal((24, 3, 5), D, rng), 0.3, torch.arange(24) // 4
    y = J @ normal((5,), D, rng) + size * normal((24, 3), D, rng)
    every = torch.ones(24, dtype=torch.bool)
    z = linear(J, y, size, every)
    found = left_out(J, torch.ones(24, 3, dtype=D), y - J @ z, size, movement)
    for number in range(6):
        without = linear(J, y, size, movement != number)
        torch.testing.assert_close(found.steps[number], without - z)
        own = movement == number
        torch.testing.assert_close(found.error[own], y[own] - J[own] @ without)


@pytest.mark.parametrize("shared", [0.0, 1.0], ids=["white noise", "errors that a movement shares"])
def test_the_covariance_is_the_scatter_of_fits(shared: float) -> None:
    """600 regressions on errors of known making: where movements share theirs, independent noise is far off."""
    rng, size, movement = generator(1), 0.5, torch.arange(240) // 4
    z = normal((600, 3), D, rng)  # as the belief before the fit has it
    J = normal((60, 1, 1, 3), D, rng).expand(60, 4, 2, 3).reshape(240, 2, 3) + 0.1 * normal((240, 2, 3), D, rng)
    scatter, told = torch.zeros(3, 3, dtype=D), torch.zeros(3, 3, dtype=D)
    posterior = torch.linalg.inv(J.flatten(0, 1).mT @ J.flatten(0, 1) / size**2 + torch.eye(3, dtype=D))
    for truth in z:
        common = normal((60, 1, 2), D, rng).expand(60, 4, 2).reshape(240, 2)
        y = J @ truth + size * (shared * common + normal((240, 2), D, rng))
        fitted = posterior @ (J.flatten(0, 1).mT @ y.flatten()) / size**2
        off = fitted - truth
        scatter += torch.outer(off, off) / 600
        told += left_out(J, torch.ones_like(y), y - J @ fitted, size, movement).covariance(posterior) / 600
    torch.testing.assert_close(told.diagonal(), scatter.diagonal(), rtol=0.25, atol=0.0)
    independent = (scatter.diagonal() / posterior.diagonal()).mean()
    assert float(independent) > 3.0 if shared else 0.8 < float(independent) < 1.2


def test_margins_find_how_errors_were_made_and_hold_as_many_new_ones() -> None:
    rng = generator(2)
    J, root = normal((2000, 2, 3, 4), D, rng), 1e-3 * normal((4, 4), D, rng)
    v = leverage(J, root @ root.mT)
    torch.testing.assert_close(v[0, 0, 0], J[0, 0, 0] @ root @ root.mT @ J[0, 0, 0])
    deviation = (9.0 * v + 4e-6).sqrt()
    found = margins(deviation * normal((2000, 2, 3), D, rng), v)
    torch.testing.assert_close(found.wander, torch.full((2,), 9.0, dtype=D), rtol=0.25, atol=0.0)
    torch.testing.assert_close(found.floor, torch.full((2,), 2e-3, dtype=D), rtol=0.25, atol=0.0)
    torch.testing.assert_close(found.reach, torch.full((2,), 1.96, dtype=D), rtol=0.05, atol=0.0)
    again = (deviation * normal((2000, 2, 3), D, rng)).abs() <= found.half_width(J, root @ root.mT)
    torch.testing.assert_close(again.double().mean((0, 2)), torch.full((2,), 0.95, dtype=D), rtol=0.0, atol=0.012)


def test_movements_are_those_of_the_recording_or_stretches_of_it() -> None:
    told = torch.tensor([7, 7, 3, 3, 3, 9, 11, 12, 13, 14, 15, 15])
    assert movements_of(told, 12).tolist() == [1, 1, 0, 0, 0, 2, 3, 4, 5, 6, 7, 7]
    for few in (None, torch.zeros(40, dtype=torch.int64)):
        assert movements_of(few, 40).tolist() == [n * STRETCHES // 40 for n in range(40)]
    assert movements_of(None, 3).tolist() == [0, 1, 2]


def test_students_distribution_by_its_table() -> None:
    for freedom, wanted in {5: 2.571, 7: 2.365, 9: 2.262, 19: 2.093, 36: 2.028, 120: 1.980}.items():
        assert student_95(freedom) == pytest.approx(wanted, rel=2e-3)
