"""What counts as a gain, and what is refused."""

from __future__ import annotations

import pytest
import torch

from apcc_torch.control.gain import gain_matrix
from apcc_torch.control.inverse_kinematics import InverseKinematics
from apcc_torch.errors import ConfigError, DtypeError, ShapeError, ValueRangeError
from laws import generator, normal


def test_forms() -> None:
    eye = torch.eye(3, dtype=torch.float64)
    assert torch.equal(gain_matrix("K", 2.0, 3), 2.0 * eye)
    assert torch.equal(gain_matrix("K", 2, 3), 2.0 * eye)
    assert torch.equal(gain_matrix("K", torch.tensor(2.0), 3), 2.0 * eye.float())
    diagonal = torch.tensor([90.0, 42.5, 35.0], dtype=torch.float64)
    assert torch.equal(gain_matrix("gamma", diagonal, 3), torch.diag(diagonal))
    root = normal((4, 3, 3), torch.float64, generator(0))
    full = root @ root.mT + eye
    have = gain_matrix("K", full, 3)
    assert torch.equal(have, full)
    law = InverseKinematics(full)
    full.zero_()  # the gain is the module's own
    assert float(law.K.diagonal(dim1=-2, dim2=-1).min()) >= 1.0
    assert torch.equal(gain_matrix("gamma", [90.0, 42.5, 35.0], 3), torch.diag(diagonal))
    rows = [[2.0, 1.0, 0.0], [1.0, 2.0, 0.0], [0.0, 0.0, 1.0]]
    assert torch.equal(gain_matrix("K", rows, 3), torch.tensor(rows, dtype=torch.float64))
    assert torch.equal(gain_matrix("gamma", ["along", 90.0, 42.5, 35.0], 3), torch.diag(diagonal))


def test_a_trained_gain_is_a_matrix() -> None:
    gain = torch.nn.Parameter(2.0 * torch.eye(3, dtype=torch.float64))
    assert InverseKinematics(gain).K is gain
    for bare in (torch.tensor(2.0), torch.ones(3)):
        with pytest.raises(ShapeError, match=r"K is trained as a matrix: hand in nn\.Parameter"):
            gain_matrix("K", torch.nn.Parameter(bare), 3)


@pytest.mark.parametrize(
    ("gain", "error", "message"),
    [
        (0.0, ValueRangeError, "K must be positive definite"),
        (-1.0, ValueRangeError, "K must be positive definite, its lowest eigenvalue is -1"),
        (float("nan"), ValueRangeError, "K is not finite"),
        (float("inf"), ValueRangeError, "K is not finite"),
        (torch.tensor([1.0, -1.0, 1.0]), ValueRangeError, "positive definite"),
        (torch.tensor([1.0, torch.nan, 1.0]), ValueRangeError, "K is not finite"),
        (torch.ones(3, 3), ValueRangeError, "positive definite"),
        (torch.eye(3) + torch.tensor([[0.0, 0.1, 0.0]] + [[0.0] * 3] * 2), ValueRangeError, "K must be symmetric"),
        (torch.stack((torch.eye(3), -torch.eye(3))), ValueRangeError, "positive definite"),
        ([1.0, 2.0], ConfigError, "K must have 3 entries, got 2"),
        ([1.0, "2", 3.0], ConfigError, "K must be a number, a list of 3 numbers or "),
        (torch.ones(2), ShapeError, r"K must have shape \(\.\.\., 3\), got \(2,\)"),
        (torch.eye(4), ShapeError, r"K must have shape \(\.\.\., 3, 3\), got \(4, 4\)"),
        (torch.ones(3, dtype=torch.int64), DtypeError, "K must be a floating-point tensor"),
    ],
)
def test_refusals(gain: float | torch.Tensor, error: type[Exception], message: str) -> None:
    with pytest.raises(error, match=message):
        gain_matrix("K", gain, 3)
