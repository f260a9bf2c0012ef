"""Small systems against the library's general routines."""

from __future__ import annotations

import torch
from hypothesis import given, settings

from apcc_torch.linalg import inverse_spd3
from laws import generator, normal, seeds

D = torch.float64


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
