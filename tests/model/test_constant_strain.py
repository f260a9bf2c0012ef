"""Piecewise constant strain: the PCC model within it, single strains in closed form, and the strains' choice."""

from __future__ import annotations

import math

import pytest
import torch
from hypothesis import given
from torch import Tensor

from apcc_torch.errors import ConfigError
from apcc_torch.model.abscissae import decouple
from apcc_torch.model.backbone import PCCBackbone
from apcc_torch.model.constant_strain import STRAINS, ConstantStrainBackbone
from arms import configurations, rest_lengths
from laws import generator, normal, rotations, seeds

D = torch.float64


@given(seed=seeds)
def test_bends_and_elongation_are_the_pcc_model(seed: int) -> None:
    rng = generator(seed)
    base = rotations((), D, rng)
    pcc, strains = PCCBackbone(3, base), ConstantStrainBackbone(3, base, ("bend_x", "bend_y", "elongation"))
    q, L0, qdot = configurations((), 3, D, rng), rest_lengths((), 3, D, rng), normal((9,), D, rng)
    where = decouple(torch.tensor([0.05, 0.2, 0.24], dtype=D), L0)
    for have, want in (
        (strains.tip_and_jacobian(q, L0), pcc.tip_and_jacobian(q, L0)),
        (strains.pose_and_body_jacobian(q, L0, *where), pcc.pose_and_body_jacobian(q, L0, *where)),
        (strains.regressor(q, qdot), pcc.regressor(q, qdot)),
        (strains.tip_jacobian_rate(q, qdot, L0), pcc.tip_jacobian_rate(q, qdot, L0)),
        (strains.coordinates, pcc.coordinates),
    ):
        if isinstance(have, (tuple, Tensor)):
            torch.testing.assert_close(have, want, rtol=0, atol=1e-12)
        else:
            assert have == want


def test_one_strain_at_a_time() -> None:
    L0 = torch.tensor([0.2], dtype=D)
    model = ConstantStrainBackbone(1)
    half_turn = math.pi / 2
    # Quarter circle of length 0.2 towards x, and towards y; a twist that moves nothing; sideways; longer.
    r = 0.2 / half_turn
    tips = {0: (r, 0.0, r), 1: (0.0, r, r), 2: (0.0, 0.0, 0.2)}
    for i, tip in tips.items():
        q = torch.zeros(6, dtype=D)
        q[i] = half_turn
        torch.testing.assert_close(model.tip(q, L0), torch.tensor(tip, dtype=D), rtol=0, atol=1e-15)
    for i, tip in {3: (0.01, 0.0, 0.2), 4: (0.0, 0.01, 0.2), 5: (0.0, 0.0, 0.21)}.items():
        q = torch.zeros(6, dtype=D)
        q[i] = 0.01
        torch.testing.assert_close(model.tip(q, L0), torch.tensor(tip, dtype=D), rtol=0, atol=1e-15)
    twisted = model.pose(torch.tensor([0, 0, half_turn, 0, 0, 0], dtype=D), L0, L0 / L0, torch.tensor([0]))[0]
    want = torch.tensor([[0, -1, 0], [1, 0, 0], [0, 0, 1]], dtype=D)
    torch.testing.assert_close(twisted[:3, :3], want, rtol=0, atol=1e-15)


def test_strains_are_named_in_order() -> None:
    model = ConstantStrainBackbone(2, strains=("elongation", "torsion", "bend_y"))
    assert model.n == 6
    assert model.coordinates.names(6) == [f"{n} {i}" for i in (1, 2) for n in ("bend y", "torsion", "elongation")]
    apart = ConstantStrainBackbone(2, strains=[["bend_x", "elongation"], ["elongation"]])
    assert apart.coordinates.names(3) == ["bend x 1", "elongation 1", "elongation 2"]
    assert ConstantStrainBackbone(1).coordinates.names(6) == [f"{c.name} 1" for c in STRAINS.values()]


def test_bad_choices_are_named() -> None:
    with pytest.raises(ConfigError, match="strains must be some of bend_x"):
        ConstantStrainBackbone(2, strains=("bend_z", "elongation"))
    with pytest.raises(ConfigError, match="names one twice"):
        ConstantStrainBackbone(2, strains=("bend_x", "bend_x", "elongation"))
    with pytest.raises(ConfigError, match="must hold elongation"):
        ConstantStrainBackbone(2, strains=("bend_x",))
    with pytest.raises(ConfigError, match="one for each of 2 sections, got 1"):
        ConstantStrainBackbone(2, strains=[["elongation"]])
    with pytest.raises(ConfigError, match="cannot have another number of sections"):
        ConstantStrainBackbone(1, strains=[["elongation"]]).resized(2)
