"""Tendons as measurements: weighed by the covariance of what they are off by."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from torch import Tensor

from apcc_torch import Arm
from apcc_torch.errors import ShapeError, ValueRangeError
from apcc_torch.estimation.loaded_shape import LoadedShape
from apcc_torch.estimation.loaded_shape_settings import LoadedShapeSettings
from apcc_torch.estimation.pose_rows import tendon_rows, tendon_weights

D = torch.float64
ARM = Arm(lengths=[0.2, 0.25], mass=0.4)


def drawn(*shape: int, seed: int = 0) -> Tensor:
    return torch.randn(*shape, generator=torch.Generator().manual_seed(seed), dtype=D)


def scattered(*rows: int) -> Tensor:
    """Covariances (..., 6, 6) m^2 of errors that go together."""
    A = 1e-3 * drawn(*rows, 6, 6, seed=1)
    return A @ A.mT + 1e-7 * torch.eye(6, dtype=D)


@pytest.mark.parametrize("rows", [(), (4,), (2, 3)])
def test_errors_that_go_together_are_weighed_by_their_covariance(rows: tuple[int, ...]) -> None:
    S, q, B, y = scattered(*rows), drawn(*rows, 5, seed=2), drawn(5, 6, seed=3), drawn(*rows, 6, seed=4)
    r, J = tendon_rows(q, B, y, 1.0, tendon_weights(S, 6))
    off, H = (y - q @ B).numpy(), np.linalg.inv(S.numpy())
    np.testing.assert_allclose((r * r).sum(-1), np.einsum("...i,...ij,...j", off, H, off), rtol=1e-8)
    np.testing.assert_allclose(J.mT @ J, B.numpy() @ H @ B.numpy().T, rtol=1e-7, atol=1e-6 * np.abs(H).max())
    np.testing.assert_allclose(
        (J.mT @ r.unsqueeze(-1))[..., 0], np.einsum("ij,...jk,...k", B.numpy(), H, off), rtol=1e-6
    )


def test_beside_an_unknown_tendon_the_others_count_each_alone() -> None:
    S, q, B, y = scattered(), drawn(2, 5), drawn(5, 6, seed=3), drawn(2, 6, seed=4)
    y[0, 2] = torch.nan
    r, J = tendon_rows(q, B, y, 1.0, tendon_weights(S, 6))
    deviation = S.diagonal().sqrt()
    alone = (y - q @ B)[0] / deviation
    alone[2] = 0.0
    torch.testing.assert_close(r[0], alone)
    expected = B.mT / deviation.unsqueeze(-1)
    expected[2] = 0.0
    torch.testing.assert_close(J[0], expected)
    whole, _ = tendon_rows(q[1], B, y[1], 1.0, tendon_weights(S, 6))
    torch.testing.assert_close(r[1], whole)


def test_a_covariance_of_one_deviation_is_tendon_noise() -> None:
    settings = LoadedShapeSettings(tendon_noise=1.5e-3)
    plain, told = LoadedShape.on(ARM, settings), LoadedShape.on(ARM, settings, 1.5e-3**2 * torch.eye(6, dtype=D))
    state = plain.initial_state(torch.tensor([0.3, 0.1, 0.2, -0.2, 0.4, 0.25], dtype=D))
    T, none = torch.eye(4, dtype=D).expand(2, 4, 4), torch.zeros(2, dtype=torch.bool)
    step = (T, none, none, 1e-3 * drawn(6), torch.tensor(0.01, dtype=D))
    for ours, theirs in zip(told(state, *step), plain(state, *step), strict=True):
        torch.testing.assert_close(ours, theirs, rtol=1e-10, atol=1e-12)


@pytest.mark.parametrize(
    ("covariance", "error", "words"),
    [
        (torch.eye(5).double(), ShapeError, "tendon_covariance"),
        (-torch.eye(6).double(), ValueRangeError, "tendon_covariance must be finite, symmetric and positive definite"),
        (torch.eye(6).double() + torch.eye(6).double().roll(1, 0), ValueRangeError, "symmetric"),
        (torch.nan * torch.eye(6).double(), ValueRangeError, "finite"),
    ],
    ids=["too small", "negative", "lopsided", "NaN"],
)
def test_what_is_no_covariance_is_refused(covariance: Tensor, error: type[Exception], words: str) -> None:
    with pytest.raises(error, match=words):
        LoadedShape.on(ARM, LoadedShapeSettings(), covariance)
