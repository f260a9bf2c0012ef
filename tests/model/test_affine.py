"""Affine curvature: the PCC model within it, the integral of its strain, and how fast its error falls with the rods."""

from __future__ import annotations

from itertools import pairwise

import pytest
import torch
from hypothesis import given
from scipy.integrate import solve_ivp
from scipy.special import fresnel

from apcc_torch.errors import ValueRangeError
from apcc_torch.lie import se3
from apcc_torch.model.affine import AffineBackbone
from apcc_torch.model.backbone import PCCBackbone
from arms import configurations, rest_lengths
from kinematic_models import shapes_of
from laws import generator, seeds

D = torch.float64
ONE = torch.ones(1, dtype=D)


@given(seed=seeds)
def test_without_slopes_it_is_the_pcc_model(seed: int) -> None:
    rng = generator(seed)
    q, L0 = configurations((), 3, D, rng), rest_lengths((), 3, D, rng)
    sloped = torch.zeros(3, 5, dtype=D)
    sloped[:, [0, 1, 4]] = q.unflatten(0, (3, 3))
    torch.testing.assert_close(
        AffineBackbone(3).tip(sloped.flatten(), L0), PCCBackbone(3).tip(q, L0), rtol=0, atol=1e-12
    )


@pytest.mark.parametrize("seed", range(4))
def test_it_integrates_its_strain(seed: int) -> None:
    # The differential equation dT/ds = T hat(xi(s)), by an integrator that shares nothing with the model.
    model = AffineBackbone(1, rods=64)
    q, L = shapes_of(model, (), D, generator(seed)), torch.tensor([0.25], dtype=D)
    x, y, dx, dy, dL = q.tolist()

    def slope(s: float, T: torch.Tensor) -> torch.Tensor:
        u = 2.0 * s - 1.0
        xi = torch.tensor([-(y + u * dy), x + u * dx, 0.0, 0.0, 0.0, 0.25 + dL], dtype=D)
        return (torch.as_tensor(T, dtype=D).view(4, 4) @ se3.hat(xi)).flatten()

    want = solve_ivp(slope, (0.0, 0.7), torch.eye(4, dtype=D).flatten(), rtol=1e-12, atol=1e-14).y[:, -1]
    have = model.pose(q, L, 0.7 * ONE, torch.tensor([0]))[0]
    torch.testing.assert_close(have, torch.from_numpy(want).view(4, 4), rtol=0, atol=1e-9)


def test_a_clothoid() -> None:
    # Curvature from zero on, in a plane: the angle is s^2, and Fresnel's integrals say where the tip is.
    model = AffineBackbone(1, rods=32)
    tip = model.tip(torch.tensor([1.0, 0.0, 1.0, 0.0, 0.0], dtype=D), ONE)
    k = (2.0 / torch.pi) ** 0.5
    sine, cosine = fresnel(k)
    torch.testing.assert_close(tip, torch.tensor([sine / k, 0.0, cosine / k], dtype=D), rtol=0, atol=2e-8)


def test_its_error_is_as_stated() -> None:
    rng = generator(0)
    fine = AffineBackbone(1, rods=128)
    q = shapes_of(fine, (300,), D, rng)
    q = torch.cat([q[:, i : i + 2] / q[:, i : i + 2].norm(dim=-1, keepdim=True) for i in (0, 2)] + [q[:, 4:]], dim=-1)
    errors = [(AffineBackbone(1, rods=rods).tip(q, ONE) - fine.tip(q, ONE)).norm(dim=-1).max() for rods in (2, 4, 8)]
    assert float(errors[1]) < 1e-4
    for coarse, finer in pairwise(errors):
        assert 12.0 < float(coarse / finer) < 20.0  # order 4: 16


def test_bad_rods_are_named() -> None:
    with pytest.raises(ValueRangeError, match="rods must be in"):
        AffineBackbone(2, rods=0)
