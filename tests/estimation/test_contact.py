"""A contact's force and place: exact where the model is the arm, and unsure where nothing tells."""

from __future__ import annotations

import pytest
import torch

from apcc_torch.errors import ConfigError, ValueRangeError
from apcc_torch.estimation.contact import ContactSearch
from apcc_torch.estimation.external_force import BalanceNoise
from apcc_torch.estimation.posture import Posture
from apcc_torch.model.abscissae import decouple
from apcc_torch.model.backbone import PCCBackbone
from arms import HANGING_BASE, PI
from laws import bits, generator, normal
from resting_arms import ROUTING, at_rest, balance, posture

D = torch.float64
SHARP = BalanceNoise(position=1e-5, angle=1e-4, tension=1e-3, bend=1e-4, length=1e-3)
FORCES = torch.tensor([[0.8, 0.3, 0.2], [0.1, -1.0, 0.4], [-0.6, 0.6, -1.0]], dtype=D)


def touched(X: float) -> Posture:
    """Postures of the model's own kind with a force at X: u is what makes them rest."""
    b = balance()
    q = 0.3 * normal((3, 9), D, generator(2)) * torch.tensor([1.0, 1.0, 0.05], dtype=D).repeat(3)
    pi = PI.expand(3, 3)
    lever = PCCBackbone(3, HANGING_BASE)
    places = decouple(torch.full((3, 1), X, dtype=D), pi)

    def work(at: torch.Tensor) -> torch.Tensor:
        return (lever.pose(at, pi, *places)[:, 0, :3, 3] * FORCES).sum()

    pushed = torch.func.grad(work)(q)
    B = ROUTING.matrix(PI)
    u = torch.linalg.solve(B, (b.body.rest_force(q, pi) - pushed).unsqueeze(-1)).squeeze(-1)
    return Posture(q, pi, u)


@pytest.mark.parametrize("X", [0.2, 0.31, 0.36, 0.47, 0.6])
def test_place_and_force_are_found(X: float) -> None:
    found = ContactSearch(balance(noise=SHARP))(touched(X))
    assert bool(found.located.all())
    torch.testing.assert_close(found.abscissa, torch.full((3,), X, dtype=D), rtol=0.0, atol=2e-3)
    torch.testing.assert_close(found.estimate.value, FORCES, rtol=0.02, atol=0.02)
    assert bool((found.interval[:, 0] <= X + 2e-3).all() and (found.interval[:, 1] >= X - 2e-3).all())
    assert bool((found.evidence > 100.0).all())
    # The tip's hypothesis is refuted where the contact is elsewhere, and only there.
    assert bool((found.gain > 100.0).all()) if X < 0.55 else bool((found.gain.abs() < 1.0).all())


def test_the_interval_holds_the_place_as_often_as_it_says() -> None:
    """Tensions drawn 300 times, everything else exact: 95 % of the intervals hold 0.31 m."""
    noise = BalanceNoise(position=0.0, angle=0.0, tension=0.05, bend=1e-5, length=1e-4)
    one = touched(0.31)
    many = Posture(*(v[:1].expand(300, v.shape[-1]) for v in one[:3] if v is not None))
    assert many.u is not None
    found = ContactSearch(balance(noise=noise))(many._replace(u=many.u + 0.05 * normal((300, 9), D, generator(6))))
    holds = (found.interval[:, 0] <= 0.31) & (found.interval[:, 1] >= 0.31)
    assert 0.92 < float(holds.double().mean()) < 0.98
    width = found.interval[:, 1] - found.interval[:, 0]
    assert 0.0 < float(width.mean()) < 0.1


def test_a_weak_contact_is_not_located() -> None:
    """Under noise that hides it, the interval spans much of the arm."""
    loud = BalanceNoise(position=2e-3, angle=0.05, tension=1.0, bend=0.3, length=1.0)
    found = ContactSearch(balance(noise=loud))(touched(0.2))
    assert not bool(found.located.any())
    assert bool((found.interval[:, 1] - found.interval[:, 0] > 0.2).all())
    assert bool((found.evidence < 30.0).all())


def test_without_a_contact_there_is_no_evidence() -> None:
    free = ContactSearch(balance(noise=SHARP))(posture(at_rest(3)))
    assert bool((free.evidence < 1e-3).all()) and bool((free.estimate.value.norm(dim=-1) < 1e-3).all())


def test_rows_do_not_mix_and_dtype_follows() -> None:
    search = ContactSearch(balance(noise=SHARP), candidates=11)
    p = touched(0.31)
    whole = search(p)
    bad = search(p._replace(q_bar=torch.cat((p.q_bar[:1] * torch.nan, p.q_bar[1:]))))
    for a, b in zip(whole[1:], bad[1:], strict=True):
        assert torch.equal(bits(a[1:]), bits(b[1:]))
    assert not bool(bad.located[0])
    single = search(Posture(*(None if v is None else v.float() for v in p)))
    assert single.abscissa.dtype == torch.float32 and single.estimate.value.dtype == torch.float32
    torch.testing.assert_close(single.abscissa.double(), whole.abscissa, rtol=0.0, atol=2e-3)


def test_bad_settings_are_named() -> None:
    with pytest.raises(ValueRangeError, match="candidates"):
        ContactSearch(balance(), candidates=2)
    single = balance(PCCBackbone(1, HANGING_BASE))
    with pytest.raises(ConfigError, match="3 coordinates"):
        ContactSearch(single)
    with pytest.raises(ValueRangeError, match="nearest"):
        ContactSearch(balance(), nearest=0.0)
