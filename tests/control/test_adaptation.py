"""Eq. (15) by hand, through the Lyapunov function of Eq. (18), and everything that bounds its speed."""

from __future__ import annotations

from typing import Any

import pytest
import torch
from hypothesis import given
from torch import Tensor
from torch.func import grad

from apcc_torch.control.adaptation import AdaptiveLaw, NormalisedLaw
from apcc_torch.errors import ConfigError, DtypeError, ShapeError, ValueRangeError
from apcc_torch.model.backbone import PCCBackbone
from arms import PI, PI_HAT, configurations
from laws import check_bad_row, generator, normal, seeds

GAMMA = torch.tensor([90.0, 42.5, 35.0], dtype=torch.float64)
DT = torch.tensor(0.01, dtype=torch.float64)


def samples(seed: int, rows: int = 5) -> tuple[Tensor, Tensor, Tensor]:
    """pi_hat, Y and e."""
    rng = generator(seed)
    Y, e = normal((rows, 3, 3), torch.float64, rng), 0.1 * normal((rows, 3), torch.float64, rng)
    return PI_HAT.repeat(rows, 1), Y, e


def test_by_hand() -> None:
    Y = torch.tensor([[1.0, 0.0, 2.0], [0.0, 3.0, 0.0], [0.0, 0.0, 4.0]], dtype=torch.float64)
    e = torch.tensor([0.1, -0.2, 0.3], dtype=torch.float64)
    # Y^T e = (0.1, -0.6, 1.4)
    law = AdaptiveLaw(3, GAMMA)
    want = torch.tensor([-9.0, 25.5, -49.0], dtype=torch.float64)
    torch.testing.assert_close(law.velocity(Y, e), want)
    torch.testing.assert_close(law(PI_HAT, Y, e, DT), PI_HAT + 0.01 * want)
    torch.testing.assert_close(AdaptiveLaw(3, 2.0).velocity(Y, e), torch.tensor([-0.2, 1.2, -2.8], dtype=torch.float64))
    mixed = torch.tensor([[2.0, 1.0, 0.0], [1.0, 2.0, 0.0], [0.0, 0.0, 1.0]], dtype=torch.float64)
    want = torch.tensor([0.4, 1.1, -1.4], dtype=torch.float64)
    torch.testing.assert_close(AdaptiveLaw(3, mixed).velocity(Y, e), want)


@given(seed=seeds)
def test_it_cancels_what_the_wrong_parameters_do_to_v(seed: int) -> None:
    # V = e^T e / 2 + pi_tilde^T Gamma^-1 pi_tilde / 2 with pi_tilde = pi - pi_hat, Eq. (18). Along xdot = J(pi) qdot
    # and this law, the part of Vdot that pi_tilde causes vanishes: no other sign does that.
    rng = generator(seed)
    backbone = PCCBackbone(3)
    q, qdot = configurations((), 3, torch.float64, rng), normal((9,), torch.float64, rng)
    e = 0.1 * normal((3,), torch.float64, rng)
    law = AdaptiveLaw(3, GAMMA)

    def V(e: Tensor, pi_hat: Tensor) -> Tensor:
        return 0.5 * e @ e + 0.5 * (PI - pi_hat) @ ((PI - pi_hat) / GAMMA)

    de, dpi = grad(V, argnums=(0, 1))(e, PI_HAT)
    # The part of edot = xdot_d - J(pi) qdot beyond what a perfect model would leave.
    excess = -(backbone.tip_jacobian(q, PI) - backbone.tip_jacobian(q, PI_HAT)) @ qdot
    pi_hat_dot = law.velocity(backbone.regressor(q, qdot)[0], e)
    assert abs(float(de @ excess + dpi @ pi_hat_dot)) < 1e-12
    assert abs(float(de @ excess)) > 1e-12


@given(seed=seeds)
def test_normalisation_and_dead_zone(seed: int) -> None:
    pi_hat, Y, e = samples(seed)
    plain = AdaptiveLaw(3, GAMMA).velocity(Y, e)
    slowed = AdaptiveLaw(3, GAMMA, normalisation=0.7).velocity(Y, e)
    for row in range(5):
        torch.testing.assert_close(slowed[row], plain[row] / (1.0 + 0.7 * torch.linalg.matrix_norm(Y[row]) ** 2))
    limit = float(e.norm(dim=-1).median())
    waiting = AdaptiveLaw(3, GAMMA, dead_zone=limit).velocity(Y, e)
    over = e.norm(dim=-1) > limit
    assert torch.equal(waiting[over], plain[over])
    assert torch.equal(waiting[~over], torch.zeros_like(waiting[~over]))
    assert torch.equal(AdaptiveLaw(3, GAMMA, dead_zone=limit)(pi_hat, Y, e, DT)[~over], pi_hat[~over])


@given(seed=seeds)
def test_rate_scales_whole_rows(seed: int) -> None:
    _, Y, e = samples(seed)
    plain = AdaptiveLaw(3, GAMMA).velocity(Y, e)
    rate = float(plain.abs().amax(-1).median())
    bounded = AdaptiveLaw(3, GAMMA, rate=rate).velocity(Y, e)
    assert float(bounded.abs().max()) <= rate * (1 + 1e-12)
    for row in range(5):
        factor = min(1.0, rate / float(plain[row].abs().max()))
        torch.testing.assert_close(bounded[row], factor * plain[row])


@given(seed=seeds)
def test_a_scaled_gain_is_the_gain_times_the_scale(seed: int) -> None:
    pi_hat, Y, e = samples(seed)
    scaled, plain = AdaptiveLaw(3, GAMMA, gain_scale=0.02), AdaptiveLaw(3, 0.02 * GAMMA)
    torch.testing.assert_close(scaled.metric, plain.metric)
    torch.testing.assert_close(scaled(pi_hat, Y, e, DT), plain(pi_hat, Y, e, DT))
    assert torch.equal(AdaptiveLaw(3, GAMMA).metric, torch.diag(GAMMA))


def test_the_shipped_law_is_eq_15_normalised_with_a_dead_zone() -> None:
    _, Y, e = samples(0)
    e[0] = 1e-5
    plain = AdaptiveLaw(3, 50.0, normalisation=10.0, dead_zone=6e-4)
    assert torch.equal(NormalisedLaw(3).velocity(Y, e), plain.velocity(Y, e))
    assert not bool(plain.velocity(Y, e)[0].any()) and bool(plain.velocity(Y, e)[1:].all())


@pytest.mark.parametrize("bad", [torch.nan, torch.inf, -torch.inf])
def test_a_step_that_is_not_finite_is_not_taken(bad: float) -> None:
    pi_hat, Y, e = samples(0)
    for settings in ({}, {"rate": 0.1}, {"normalisation": 1.0}, {"dead_zone": 1e-3}):
        law = AdaptiveLaw(3, GAMMA, **settings)
        good = law(pi_hat, Y, e, DT)
        for k in range(2):
            inputs = [Y.clone(), e.clone()]
            inputs[k][1] = bad
            stepped = law(pi_hat, *inputs, DT)
            assert torch.isfinite(stepped).all()
            assert torch.equal(stepped[[0, 2, 3, 4]], good[[0, 2, 3, 4]])
            torch.testing.assert_close(stepped[1], pi_hat[1])
    check_bad_row(AdaptiveLaw(3, GAMMA), (pi_hat, Y, e, DT.expand(5)))


def test_gains_differ_by_row() -> None:
    pi_hat, Y, e = samples(3, rows=2)
    gamma = torch.stack((torch.eye(3), 5.0 * torch.eye(3))).double()
    both = AdaptiveLaw(3, gamma)(pi_hat, Y, e, torch.tensor([0.01, 0.02]).double())
    for row in range(2):
        one = AdaptiveLaw(3, gamma[row])
        step = one(pi_hat[row], Y[row], e[row], torch.tensor([0.01, 0.02][row]).double())
        torch.testing.assert_close(both[row], step)


def test_refusals() -> None:
    def refused(match: str, error: type[Exception] = ValueRangeError, **settings: Any) -> None:
        with pytest.raises(error, match=match):
            AdaptiveLaw(3, **{"gamma": GAMMA, **settings})

    refused("regressor must be one of partial, estimator_aware", ConfigError, regressor="total")
    refused("gamma must be positive and finite", gamma=torch.tensor([1.0, 0.0, 1.0]))
    refused("gamma must have shape", ShapeError, gamma=torch.ones(2))
    for name in ("normalisation", "dead_zone", "rate", "gain_scale"):
        for value in (-1.0, float("nan"), float("inf")):
            refused(name, **{name: value})
    refused("rate must be positive", rate=0.0)
    law = AdaptiveLaw(3, GAMMA)
    pi_hat, Y, e = samples(0)
    with pytest.raises(ShapeError, match="Y must have shape"):
        law.velocity(Y[..., :2], e)
    with pytest.raises(ShapeError, match="pi_hat must have shape"):
        law(pi_hat[:, :2], Y, e, DT)
    with pytest.raises(DtypeError, match=r"e is torch\.float32"):
        law.velocity(Y, e.float())
