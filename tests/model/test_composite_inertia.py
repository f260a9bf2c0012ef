"""The inertia matrix in parts: the recursion over the sections against the matrix put together."""

from __future__ import annotations

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from apcc_torch.linalg import solve_spd
from apcc_torch.model import composite_inertia as composite
from apcc_torch.model.composite_inertia import Composite, assembled, solved_recursively
from apcc_torch.model.dynamics import SoftArmDynamics
from apcc_torch.model.stiffness import scaled_stiffness
from laws import generator, normal, seeds

D = torch.float64


def parts(n_b: int, shape: tuple[int, ...], seed: int) -> Composite:
    """Parts of a random positive definite matrix: a chain of bodies of random inertia."""
    rng = generator(seed)
    carrying = normal((6, 3, n_b, *shape), D, rng)
    half = normal((6, 6, n_b, *shape), D, rng)
    inertia = torch.einsum("ikn...,jkn...->ijn...", half, half)
    beyond = inertia.flip(2).cumsum(2).flip(2)
    moving = torch.einsum("ijn...,jcn...->icn...", beyond, carrying)
    diagonal = torch.einsum("icn...,idn...->cdn...", carrying, moving)
    return Composite(moving, carrying, diagonal + 0.5 * torch.eye(3, dtype=D).reshape(3, 3, 1, *[1] * len(shape)))


@given(n_b=st.integers(1, 7), shape=st.sampled_from(((), (1,), (2, 3))), seed=seeds)
@settings(deadline=None, max_examples=25)
def test_recursion_solves_the_matrix(n_b: int, shape: tuple[int, ...], seed: int) -> None:
    given_parts = parts(n_b, shape, seed)
    M, force = assembled(given_parts), normal((*shape, 3 * n_b), D, generator(seed + 1))
    torch.testing.assert_close(M, M.mT, rtol=0, atol=0)
    for row in range(n_b):
        for column in range(row):
            block = torch.einsum(
                "ic...,id...->...cd", given_parts.moving[:, :, row], given_parts.carrying[:, :, column]
            )
            torch.testing.assert_close(M[..., 3 * row : 3 * row + 3, 3 * column : 3 * column + 3], block)
    x = solved_recursively(given_parts, force)
    torch.testing.assert_close((M @ x.unsqueeze(-1)).squeeze(-1), force, rtol=0, atol=1e-9)


@pytest.mark.parametrize(("n_b", "rows"), [(14, 200), (32, 40)])
def test_long_arms_take_the_recursion(n_b: int, rows: int, monkeypatch: pytest.MonkeyPatch) -> None:
    lengths = torch.full((n_b,), 0.6 / n_b, dtype=D)
    axial, bending = scaled_stiffness(lengths)
    arm = SoftArmDynamics(lengths, lengths, axial, bending, damping_ratio=0.1)
    q = 0.1 * normal((rows, 3 * n_b), D, generator(0))
    q[:, 2::3] *= 0.02
    tau = torch.zeros_like(q)
    have = arm(q, q, tau, payload=0.2)
    monkeypatch.setattr(composite, "RECURSIVE_SECTIONS", 1000)
    want = arm(q, q, tau, payload=0.2)
    assert not torch.equal(have, want)  # two ways, not one
    torch.testing.assert_close(have, want, rtol=1e-8, atol=1e-8 * float(want.abs().max()))


def test_a_row_that_is_not_positive_definite_is_nan_alone() -> None:
    given_parts = parts(3, (4,), 0)
    bad = given_parts.diagonal.clone()
    bad[:, :, 1, 2] *= -1.0
    force = torch.ones(4, 9, dtype=D)
    x = solved_recursively(given_parts._replace(diagonal=bad), force)
    assert x[2].isnan().any() and torch.equal(x.isfinite().all(-1), torch.tensor([True, True, False, True]))
    want = solve_spd(assembled(given_parts), force.unsqueeze(-1)).squeeze(-1)
    torch.testing.assert_close(x[[0, 1, 3]], want[[0, 1, 3]])


def test_gradients_through_the_recursion() -> None:
    given_parts = parts(3, (), 1)
    inputs = tuple(p.clone().requires_grad_() for p in given_parts)
    force = torch.ones(9, dtype=D)

    def solve(*values: torch.Tensor) -> torch.Tensor:
        # Symmetric whatever the perturbation: both triangles of the sections' own blocks count.
        return solved_recursively(Composite(values[0], values[1], 0.5 * (values[2] + values[2].transpose(0, 1))), force)

    assert torch.autograd.gradcheck(solve, inputs)
