"""Theorem 1 against automatic differentiation, for arms of one to six sections."""

from __future__ import annotations

import torch
from hypothesis import given
from hypothesis import strategies as st
from torch import Tensor
from torch.func import jacfwd

from apcc_torch.model.backbone import PCCBackbone
from arms import configurations, rest_lengths
from laws import check_gradients, generator, normal, rotations, seeds

sections = st.integers(1, 6)


def moving_arm(seed: int, n: int) -> tuple[PCCBackbone, Tensor, Tensor, Tensor]:
    """A backbone on a random base, q, qdot and L0."""
    rng = generator(seed)
    backbone = PCCBackbone(n, rotations((), torch.float64, rng))
    q = configurations((), n, torch.float64, rng, bend=2.0, elongation=0.05)
    return backbone, q, normal((3 * n,), torch.float64, rng), rest_lengths((), n, torch.float64, rng)


def tip_velocity(backbone: PCCBackbone, q: Tensor, qdot: Tensor, L0: Tensor) -> Tensor:
    return jacfwd(backbone.tip)(q, L0) @ qdot


@given(seed=seeds, n=sections)
def test_theorem_1(seed: int, n: int) -> None:
    backbone, q, qdot, L0 = moving_arm(seed, n)
    Y, Phi = backbone.regressor(q, qdot)
    velocity = tip_velocity(backbone, q, qdot, L0)
    torch.testing.assert_close(Y @ L0 + Phi, velocity, rtol=0, atol=1e-12)
    torch.testing.assert_close(Y, jacfwd(lambda L0: tip_velocity(backbone, q, qdot, L0))(L0), rtol=0, atol=1e-12)
    # What is left where every section has no rest length.
    torch.testing.assert_close(Phi, tip_velocity(backbone, q, qdot, torch.zeros_like(L0)), rtol=0, atol=1e-12)


@given(seed=seeds, n=sections)
def test_velocity_is_linear_in_the_parameters(seed: int, n: int) -> None:
    backbone, q, qdot, L0 = moving_arm(seed, n)
    curvature = jacfwd(jacfwd(lambda L0: backbone.tip_jacobian(q, L0) @ qdot))(L0)
    assert torch.equal(curvature, torch.zeros_like(curvature))
    # In the parameters' error, as the law uses it: (J(pi) - J(pi_hat)) qdot = Y (pi - pi_hat).
    other = rest_lengths((), n, torch.float64, generator(seed + 1))
    gap = (backbone.tip_jacobian(q, L0) - backbone.tip_jacobian(q, other)) @ qdot
    torch.testing.assert_close(backbone.regressor(q, qdot)[0] @ (L0 - other), gap, rtol=0, atol=1e-12)


@given(seed=seeds)
def test_each_section_moves_what_lies_beyond_it(seed: int) -> None:
    # Only the last section bends: the lengths before it carry it and cannot matter.
    backbone, q, qdot, _ = moving_arm(seed, 4)
    qdot[:9] = 0.0
    Y, _ = backbone.regressor(q, qdot)
    torch.testing.assert_close(Y[:, :3], torch.zeros(3, 3).double(), rtol=0, atol=0)
    assert float(Y[:, 3].norm()) > 0.0


@given(seed=seeds, n=sections)
def test_the_jacobians_rate_holds_the_regressor(seed: int, n: int) -> None:
    # The tip moves with delta L as it does with L, whatever the lengths are.
    backbone, q, qdot, L0 = moving_arm(seed, n)
    rate = backbone.tip_jacobian_rate(q, qdot, L0)
    torch.testing.assert_close(rate[:, 2::3], backbone.regressor(q, qdot)[0], rtol=0, atol=1e-12)


def test_derivatives_at_the_straight_pose() -> None:
    backbone = PCCBackbone(3)
    qdot = normal((9,), torch.float64, generator(0))
    check_gradients(backbone.regressor, torch.zeros(9), qdot)


def test_q_and_qdot_broadcast() -> None:
    rng = generator(2)
    backbone = PCCBackbone(3)
    q, qdot = configurations((4, 1), 3, torch.float64, rng), normal((5, 9), torch.float64, rng)
    Y, Phi = backbone.regressor(q, qdot)
    assert Y.shape == (4, 5, 3, 3) and Phi.shape == (4, 5, 3)
    torch.testing.assert_close(Y[2, 3], backbone.regressor(q[2, 0], qdot[3])[0])
