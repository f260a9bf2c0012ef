"""Eqs. (52) and (53) on curves whose distance is known."""

from __future__ import annotations

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from torch import Tensor

from apcc_torch.errors import DtypeError, ShapeError
from apcc_torch.estimation.state_feedback import StateFeedback
from apcc_torch.model.abscissae import decouple
from apcc_torch.model.backbone import PCCBackbone
from apcc_torch.simulation.metrics import (
    backbone_error,
    mapping_error,
    orientation_error,
    shape_error,
    velocity_quality,
)
from arms import PI, PI_HAT, configurations, rest_lengths
from laws import generator, normal, seeds


@given(seed=seeds)
def test_shape_error_by_hand(seed: int) -> None:
    rng = generator(seed)
    p, step = normal((4, 7, 3), torch.float64, rng), normal((4, 1, 3), torch.float64, rng)
    torch.testing.assert_close(shape_error(p, p + step), step[:, 0].norm(dim=-1))
    other = normal((4, 7, 3), torch.float64, rng)
    want = [sum(float((p[r, i] - other[r, i]).norm()) for i in range(7)) / 7 for r in range(4)]
    torch.testing.assert_close(shape_error(p, other), torch.tensor(want, dtype=torch.float64))


def test_backbone_error_of_two_lengths() -> None:
    # Two straight arms: corresponding points are apart by their share of the difference in length.
    backbone = PCCBackbone(3)
    straight = torch.zeros(9, dtype=torch.float64)
    gap = float(PI_HAT.sum() - PI.sum())
    have = backbone_error(backbone, straight, PI, backbone, straight, PI_HAT)
    torch.testing.assert_close(have, torch.tensor(gap / 2.0, dtype=torch.float64))


def test_backbone_error_depends_on_the_curves_alone() -> None:
    rng = generator(1)
    true, model = PCCBackbone(6), PCCBackbone(3)
    q, L0 = configurations((5,), 3, torch.float64, rng), rest_lengths((5,), 3, torch.float64, rng)
    halves = (q.unflatten(-1, (3, 3)) / 2.0).repeat_interleave(2, dim=-2).flatten(-2)
    have = backbone_error(true, halves, (L0 / 2.0).repeat_interleave(2, dim=-1), model, q, L0)
    torch.testing.assert_close(have, torch.zeros(5).double(), rtol=0, atol=1e-12)


def test_chunks_make_no_difference() -> None:
    rng = generator(2)
    true, model = PCCBackbone(4), PCCBackbone(3)
    q_true, q = configurations((7, 1), 4, torch.float64, rng), configurations((7, 3), 3, torch.float64, rng)
    L0_true, L0 = rest_lengths((), 4, torch.float64, rng), rest_lengths((3,), 3, torch.float64, rng)
    whole = backbone_error(true, q_true, L0_true, model, q, L0, N=50)
    assert whole.shape == (7, 3)
    chunked = backbone_error(true, q_true, L0_true, model, q, L0, N=50, chunk_rows=4)
    torch.testing.assert_close(chunked, whole, rtol=0, atol=1e-14)
    direct = shape_error(true.points(q_true, L0_true, 50), model.points(q, L0, 50))
    torch.testing.assert_close(whole, direct, rtol=0, atol=1e-14)


def test_mapping_error() -> None:
    backbone = PCCBackbone(3)
    q = configurations((5,), 3, torch.float64, generator(3))
    away = torch.tensor([0.03, 0.0, -0.04], dtype=torch.float64)
    have = mapping_error(backbone, q, PI, backbone.tip(q, PI) + away)
    torch.testing.assert_close(have, torch.full((5,), 0.05, dtype=torch.float64))


def test_refusals() -> None:
    p = torch.zeros(7, 3)
    with pytest.raises(ShapeError, match=r"p_approx must have shape \(\.\.\., 7, 3\)"):
        shape_error(p, p[:6])
    with pytest.raises(ShapeError, match="p_true must have shape"):
        shape_error(p[:, :2], p)
    with pytest.raises(DtypeError, match="p_approx"):
        shape_error(p, p.double())


def test_orientation_error_is_what_algorithm_2_reports_of_poses() -> None:
    backbone, rng = PCCBackbone(3), generator(3)
    sensors = torch.tensor([0.1, 0.3, 0.55], dtype=torch.float64)
    T = backbone.pose(configurations((4,), 3, torch.float64, rng), PI, *decouple(sensors, PI))
    # With wrong rest lengths the sensors do not fit, and both see by how much.
    found = StateFeedback(backbone, sensors)(torch.zeros(4, 9, dtype=torch.float64), PI_HAT, T)
    have = orientation_error(backbone, found.q_bar, PI_HAT, sensors, T[..., :3, :3])
    torch.testing.assert_close(have, found.angular_error, rtol=1e-3, atol=1e-6)
    assert float(have.max()) > 1e-3


@given(seed=seeds, lag=st.floats(0.0, 0.05), factor=st.floats(0.5, 2.0))
def test_lag_and_noise_are_found(seed: int, lag: float, factor: float) -> None:
    time = 0.005 * torch.arange(2000, dtype=torch.float64)
    noise = 1e-3 * torch.randn(2000, 3, generator=generator(seed), dtype=torch.float64)

    def velocity(t: Tensor) -> Tensor:
        return torch.stack((torch.sin(t), 0.5 * torch.cos(1.3 * t), torch.sin(0.7 * t + 1.0)), dim=-1)

    found = velocity_quality(factor * velocity(time - lag) + noise, velocity(time), 0.005)
    assert found.lag.item() == pytest.approx(lag, abs=1e-3)
    assert found.noise.item() == pytest.approx(3**0.5 * 1e-3, rel=0.1, abs=factor * lag**2)
