"""Bounds on vectors, entry by entry."""

from __future__ import annotations

import torch
from torch import Tensor

from apcc_torch.control.bounds import within

D = torch.float64


def rows(*values: float) -> Tensor:
    return torch.tensor(values, dtype=D)


def test_within_holds_each_row_to_its_bound() -> None:
    x = rows(-2.0, 0.5, 2.0).expand(2, 3)
    assert within(x, rows(1.0, 0.1)).tolist() == [[-1.0, 0.5, 1.0], [-0.1, 0.1, 0.1]]
    assert within(x, 1.0).tolist() == [[-1.0, 0.5, 1.0]] * 2
    assert within(x, None) is x
