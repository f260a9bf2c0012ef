"""Weight and elasticity of a resting arm: against energies, against the dynamics, and as laws of a batch."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor

from apcc_torch.errors import ConfigError, ValueRangeError
from apcc_torch.model.affine import AffineBackbone
from apcc_torch.model.constant_strain import ConstantStrainBackbone
from apcc_torch.model.static_body import StaticBody
from arms import HANGING_BASE, PI, configurations, rest_lengths
from kinematic_models import MODELS, random_model, shapes_of
from laws import check_batching, generator
from resting_arms import MATERIAL, arm

D = torch.float64
REST = {"torsion": 0.05, "shear": 300.0}


@pytest.mark.parametrize("name", list(MODELS))
def test_the_weight_is_the_gradient_of_the_height_of_the_mass(name: str) -> None:
    model, q, L0 = random_model(name, 3, 3)
    body = StaticBody(model, *MATERIAL, **REST)
    q = q.requires_grad_()
    # The middle rule with many points, where the body takes four of Gauss.
    N = 400
    X_tilde = ((torch.arange(N, dtype=D) + 0.5) / N).repeat(3)
    height = model.pose(q, L0, X_tilde, torch.arange(3).repeat_interleave(N))[..., 2, 3]
    energy = 9.81 * MATERIAL[0] * (height * (L0 / N).repeat_interleave(N)).sum()
    (slope,) = torch.autograd.grad(energy, q)
    torch.testing.assert_close(body.gravity(q, L0), slope, rtol=2e-5, atol=2e-5)


def test_it_is_that_of_the_dynamics() -> None:
    dynamics = arm(damping_ratio=0.1)
    body = StaticBody(MODELS["pcc"](3, HANGING_BASE), *MATERIAL)
    q = configurations((6,), 3, D, generator(1))
    torch.testing.assert_close(body.gravity(q, PI), dynamics.gravity(q), rtol=1e-12, atol=1e-13)
    torch.testing.assert_close(body.stiffness(PI), dynamics.stiffness_diagonal)
    torch.testing.assert_close(body.rest_force(q, PI), dynamics.gravity(q) + dynamics.stiffness_diagonal * q)


def test_slopes_store_the_energy_of_their_curvature() -> None:
    body = StaticBody(AffineBackbone(2), *MATERIAL)
    lengths = torch.tensor([0.2, 0.3], dtype=D)
    q = torch.tensor([0.4, -0.3, 0.2, 0.5, 0.01, -0.1, 0.2, -0.4, 0.3, -0.02], dtype=D)
    stored = 0.5 * (body.stiffness(lengths) * q * q).sum()
    s = (torch.arange(2000, dtype=D) + 0.5) / 2000
    wanted = torch.zeros((), dtype=D)
    for section, L in zip(q.view(2, 5), lengths, strict=True):
        bend = section[:2, None] + (2.0 * s - 1.0) * section[2:4, None]
        wanted = wanted + 0.5 * MATERIAL[2] / L * (bend**2).sum(0).mean() + 0.5 * MATERIAL[1] * section[4] ** 2 / L
    torch.testing.assert_close(stored, wanted, rtol=1e-6, atol=0.0)


def test_torsion_and_shear_have_their_rigidity() -> None:
    model = ConstantStrainBackbone(1)
    K = StaticBody(model, 1.0, 10.0, 2.0, torsion=3.0, shear=4.0).stiffness(torch.tensor([0.5], dtype=D))
    assert K.tolist() == [4.0, 4.0, 6.0, 8.0, 8.0, 20.0]


@pytest.mark.parametrize("name", ["pcc", "affine"])
def test_point_jacobians_move_the_points(name: str) -> None:
    model, q, L0 = random_model(name, 5, 3)
    body = StaticBody(model, *MATERIAL)
    X = L0.sum() * torch.tensor([0.2, 0.55, 1.0], dtype=D)
    moved = torch.func.jacfwd(lambda at: body.points(at, L0, X))(q)
    torch.testing.assert_close(body.point_jacobians(q, L0, X), moved, rtol=1e-6, atol=1e-6)


def test_leading_dimensions_are_a_batch() -> None:
    body = StaticBody(MODELS["affine"](2, HANGING_BASE), *MATERIAL)

    def inputs(shape: tuple[int, ...], dtype: torch.dtype, rng: torch.Generator) -> tuple[Tensor, ...]:
        return shapes_of(body.backbone, shape, dtype, rng), rest_lengths(shape, 2, dtype, rng)

    check_batching(body.rest_force, inputs, shared=(0, 1), scale=20.0)


def test_bad_settings_are_named() -> None:
    with pytest.raises(ConfigError, match="torsion must be given"):
        StaticBody(ConstantStrainBackbone(2, None, ("bend_x", "torsion", "elongation")), *MATERIAL)
    with pytest.raises(ValueRangeError, match="density"):
        StaticBody(MODELS["pcc"](2, None), -1.0, 10.0, 0.1)
    with pytest.raises(ValueRangeError, match="n_quadrature"):
        StaticBody(MODELS["pcc"](2, None), *MATERIAL, n_quadrature=1)
