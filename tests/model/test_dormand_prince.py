"""The adaptive reference: a closed form, every row with its own steps, and rows that blow up alone."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor

from apcc_torch.errors import ValueRangeError
from apcc_torch.model.dormand_prince import reference
from laws import bits

D = torch.float64


def test_reference_against_a_closed_form() -> None:
    rate = torch.tensor([1.0, 10.0, 100.0], dtype=D)

    def spiral(t: Tensor, x: Tensor) -> Tensor:
        return rate.unsqueeze(-1) * torch.stack((x[..., 1], -x[..., 0]), dim=-1)

    times = torch.linspace(0.0, 1.0, 4, dtype=D)
    run = reference(spiral, torch.tensor([[1.0, 0.0]] * 3, dtype=D), times)
    angle = times[:, None] * rate
    torch.testing.assert_close(run.states, torch.stack((angle.cos(), -angle.sin()), -1), rtol=0, atol=1e-6)
    # Each row takes its own steps.
    assert run.steps[2] > 5 * run.steps[0]
    with pytest.raises(ValueRangeError, match="times"):
        reference(spiral, torch.ones(3, 2, dtype=D), times.flip(0))


def test_reference_freezes_a_row_that_blows_up() -> None:
    def explode(t: Tensor, x: Tensor) -> Tensor:
        return x * x  # x(t) = x0 / (1 - x0 t)

    times = torch.linspace(0.0, 1.0, 6, dtype=D)
    alone = reference(explode, torch.tensor([[0.5], [0.3]], dtype=D), times)
    mixed = reference(explode, torch.tensor([[0.5], [2.0], [0.3], [torch.nan]], dtype=D), times)
    assert mixed.diverged_at.tolist() == [-1, 3, -1, 1]
    assert torch.equal(bits(mixed.states[:, [0, 2]]), bits(alone.states))
    assert bool(mixed.states[:, 1].isfinite().all())
