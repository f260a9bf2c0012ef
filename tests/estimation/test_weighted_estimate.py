"""Weighted least squares that says what it does not know."""

from __future__ import annotations

import torch
from torch import Tensor

from apcc_torch.estimation.weighted_estimate import EstimateStatus, weighted_estimate
from laws import check_bad_row, check_batching, check_gradients, generator, normal

D = torch.float64
LIMIT = torch.full((3,), 1e3, dtype=D)


def problem(shape: tuple[int, ...], dtype: torch.dtype, rng: torch.Generator) -> tuple[Tensor, Tensor, Tensor]:
    """r (..., 8), Phi (..., 8, 3) and a covariance."""
    root = normal((*shape, 8, 8), torch.float64, rng) * 0.3 + torch.eye(8, dtype=D)
    S = root @ root.mT + 0.5 * torch.eye(8, dtype=D)
    return normal((*shape, 8), dtype, rng), normal((*shape, 8, 3), dtype, rng), S.to(dtype)


def test_it_is_least_squares_of_the_whitened_problem() -> None:
    r, Phi, S = problem((5,), D, generator(1))
    found = weighted_estimate(r, Phi, S, LIMIT)
    whiten = torch.linalg.inv(torch.linalg.cholesky(S))
    A, b = whiten @ Phi, (whiten @ r.unsqueeze(-1)).squeeze(-1)
    wanted = torch.linalg.lstsq(A, b.unsqueeze(-1)).solution.squeeze(-1)
    torch.testing.assert_close(found.value, wanted, rtol=1e-6, atol=1e-7)
    torch.testing.assert_close(found.covariance, torch.linalg.inv(A.mT @ A), rtol=1e-6, atol=1e-8)
    left = b - (A @ wanted.unsqueeze(-1)).squeeze(-1)
    torch.testing.assert_close(found.misfit, (left * left).sum(-1), rtol=1e-6, atol=1e-9)
    assert (found.status == EstimateStatus.DETERMINED).all()


def test_its_covariance_is_the_spread_of_the_estimates() -> None:
    _, Phi, S = problem((), D, generator(2))
    theta = torch.tensor([1.0, -2.0, 0.5], dtype=D)
    noise = normal((20000, 8), D, generator(3)) @ torch.linalg.cholesky(S).mT
    found = weighted_estimate(Phi @ theta + noise, Phi, S, LIMIT)
    torch.testing.assert_close(found.value.mean(0), theta, rtol=0.0, atol=0.03)
    torch.testing.assert_close(found.value.mT.cov(), found.covariance[0], rtol=0.05, atol=0.01)
    assert abs(float(found.misfit.mean()) - 5.0) < 0.1  # chi-square of 8 - 3 degrees of freedom


def test_what_no_equation_sees_is_reported_and_costs_the_others_nothing() -> None:
    r, Phi, S = problem((2,), D, generator(4))
    blind = Phi.clone()
    blind[..., 1] = 0.0
    found = weighted_estimate(r, blind, S, torch.ones(3, dtype=D) * 10.0)
    assert (found.status == EstimateStatus.PARTLY).all()
    assert torch.isfinite(found.value).tolist() == [[True, False, True]] * 2
    alone = weighted_estimate(r, blind[..., [0, 2]], S, torch.ones(2, dtype=D) * 10.0)
    torch.testing.assert_close(found.value[..., [0, 2]], alone.value)
    assert (found.deviation[..., 1] > 10.0).all()
    none = weighted_estimate(r, torch.zeros_like(Phi), S, LIMIT)
    assert (none.status == EstimateStatus.UNDETERMINED).all() and bool(none.value.isnan().all())


def test_an_oblique_unseen_direction_leaves_no_component_known() -> None:
    Phi = torch.zeros(8, 2, dtype=D)
    Phi[0] = 1.0  # the sum of both alone
    found = weighted_estimate(torch.ones(8, dtype=D), Phi, torch.eye(8, dtype=D), torch.full((2,), 10.0, dtype=D))
    assert found.status == EstimateStatus.UNDETERMINED
    sum_of_both = torch.ones(2, dtype=D)
    assert float(sum_of_both @ found.covariance @ sum_of_both) < 1.1  # and its covariance still tells the sum


def test_rows_that_make_no_sense_are_invalid() -> None:
    r, Phi, S = problem((3,), D, generator(5))
    r[0, 0] = torch.nan
    S[1] = -S[1]
    found = weighted_estimate(r, Phi, S, LIMIT)
    assert found.status.tolist() == [EstimateStatus.INVALID, EstimateStatus.INVALID, EstimateStatus.DETERMINED]


def test_laws() -> None:
    def op(r: Tensor, Phi: Tensor, S: Tensor) -> tuple[Tensor, ...]:
        return tuple(weighted_estimate(r, Phi, S, LIMIT.to(r)))

    check_batching(op, problem, shared=(1, 2), scale=10.0)
    check_bad_row(op, problem((3,), D, generator(6)))
    r, Phi, S = problem((), D, generator(7))
    check_gradients(lambda a, b: weighted_estimate(a, b, S, LIMIT).value, r, Phi)
