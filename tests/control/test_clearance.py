"""Distances against brute force, the cost's gradient against finite differences, and the way around a ball."""

from __future__ import annotations

import pytest
import torch
from hypothesis import given, settings
from torch import Tensor

from apcc_torch.control.clearance import ClearanceCost
from apcc_torch.control.obstacles import Capsule, HalfSpace, Obstacle, Sphere
from apcc_torch.errors import ShapeError, ValueRangeError
from apcc_torch.model.backbone import PCCBackbone
from arms import HANGING_BASE, PI, configurations, rest_lengths
from laws import check_bad_row, check_batching, check_gradients, generator, normal, seeds

BACKBONE = PCCBackbone(3, HANGING_BASE)


def vector(*values: float) -> Tensor:
    return torch.tensor(values, dtype=torch.float64)


def obstacles() -> list[Obstacle]:
    return [
        Sphere(vector(0.1, 0.05, -0.3), 0.08),
        Capsule(vector(-0.3, 0.1, -0.2), vector(0.2, 0.1, -0.5), 0.03),
        HalfSpace(vector(0.0, 0.0, -0.4), vector(0.2, 0.0, 2.0)),
    ]


@given(seed=seeds)
@settings(max_examples=20)
def test_distances(seed: int) -> None:
    rng = generator(seed)
    p, start, end = normal((6, 3), torch.float64, rng), *normal((2, 3), torch.float64, rng)
    share = torch.linspace(0, 1, 4001, dtype=torch.float64).unsqueeze(-1)
    nearest = torch.cdist(p, start + share * (end - start)).amin(-1)
    torch.testing.assert_close(Capsule(start, end, 0.2)(p)[0], nearest - 0.2, rtol=0, atol=1e-3)
    torch.testing.assert_close(Sphere(start, 0.3)(p)[0], (p - start).norm(dim=-1) - 0.3)
    wall = HalfSpace(start, end)(p)[0]
    torch.testing.assert_close(wall, (p - start) @ end / end.norm())


@pytest.mark.parametrize("k", range(3))
def test_gradients_of_distances(k: int) -> None:
    obstacle = obstacles()[k]
    p = normal((5, 3), torch.float64, generator(2)).requires_grad_()
    distance, away = obstacle(p)
    torch.testing.assert_close(away, torch.autograd.grad(distance.sum(), p)[0])
    check_gradients(lambda p: obstacle(p)[0], normal((5, 3), torch.float64, generator(3)))


def test_the_middle_of_a_ball_has_no_direction() -> None:
    distance, away = Sphere(vector(1, 2, 3), 0.5)(vector(1, 2, 3).unsqueeze(0))
    assert float(distance) == -0.5 and float(away.norm()) == 0.0


@pytest.mark.parametrize(("near", "separation"), [(True, None), (True, 0.15), (False, 0.15)])
def test_the_gradient_of_the_cost(near: bool, separation: float | None) -> None:
    rng = generator(4)
    q, L0 = configurations((8,), 3, torch.float64, rng, bend=2.5), rest_lengths((8,), 3, torch.float64, rng)
    cost = ClearanceCost(obstacles() if near else [], 0.03, 0.2, 17, separation)
    value, slope = cost(BACKBONE, q, L0)
    assert float(value.max()) > 0.0
    h = 1e-6
    for i in range(9):
        step = h * torch.eye(9, dtype=torch.float64)[i]
        want = (cost(BACKBONE, q + step, L0)[0] - cost(BACKBONE, q - step, L0)[0]) / (2 * h)
        torch.testing.assert_close(slope[:, i], want, rtol=1e-5, atol=1e-6)
    torch.testing.assert_close(cost.descent(BACKBONE, q, L0), -slope)


def test_far_away_nothing_counts() -> None:
    cost = ClearanceCost([Sphere(vector(3, 0, 0), 0.1)], radius=0.03, activation=0.05)
    value, slope = cost(BACKBONE, torch.zeros(9).double(), PI)
    assert float(value) == 0.0 and float(slope.abs().max()) == 0.0
    near = cost.clearance(BACKBONE, torch.zeros(9).double(), PI)
    # The arm hangs along z; its first point below the base is the nearest.
    top = 0.6 / 23
    assert float(near.obstacles) == pytest.approx((9 + top**2) ** 0.5 - 0.13)
    assert float(near.self) == float("inf")


def test_a_ring_comes_near_itself() -> None:
    # One section bent by a whole turn but a little: its tip comes back to its base.
    arm = PCCBackbone(1)
    L0 = vector(0.6)
    cost = ClearanceCost(radius=0.01, points=61, self_separation=0.2)
    open_arm = cost.clearance(arm, vector(1.0, 0.0, 0.0), L0).self
    ring = cost.clearance(arm, vector(6.1, 0.0, 0.0), L0).self
    radius = 0.6 / 6.1
    first, last = 6.1 / 60, 6.1
    chord = 2 * radius * torch.sin(vector(last - first) / 2).abs()
    torch.testing.assert_close(ring, chord[0] - 0.02, rtol=0, atol=1e-9)
    assert float(open_arm) > float(ring)
    # Downhill the ring opens.
    closed, opened = vector(6.1, 0.0, 0.0), None
    opened = closed + 1e-4 * cost.descent(arm, closed, L0)
    assert float(cost.clearance(arm, opened, L0).self) > float(ring)


def test_leading_dimensions_are_a_batch() -> None:
    cost = ClearanceCost(obstacles(), 0.03, 0.3, 9, 0.2)

    def inputs(shape: tuple[int, ...], dtype: torch.dtype, rng: torch.Generator) -> tuple[Tensor, ...]:
        return configurations(shape, 3, dtype, rng), rest_lengths(shape, 3, dtype, rng)

    def op(q: Tensor, L0: Tensor) -> tuple[Tensor, ...]:
        return (*cost(BACKBONE, q, L0), *cost.clearance(BACKBONE, q, L0))

    check_batching(op, inputs, shared=(1,), scale=10.0)
    check_bad_row(op, inputs((3,), torch.float64, generator(5)))


def test_rows_may_differ() -> None:
    q, L0 = configurations((2,), 3, torch.float64, generator(6)), PI
    centres, radii = torch.stack((vector(0.1, 0, -0.3), vector(-0.1, 0, -0.3))), vector(0.05, 0.1)
    both = ClearanceCost([Sphere(centres, radii)], vector(0.01, 0.02), vector(0.2, 0.3), self_separation=0.1)
    for i in range(2):
        args = (float(v[i]) for v in (vector(0.01, 0.02), vector(0.2, 0.3)))
        one = ClearanceCost([Sphere(centres[i], float(radii[i]))], *args, self_separation=0.1)
        torch.testing.assert_close(both(BACKBONE, q, L0)[1][i], one(BACKBONE, q[i], L0)[1])


def test_refusals() -> None:
    with pytest.raises(ValueRangeError, match="nothing to keep clear of"):
        ClearanceCost()
    with pytest.raises(ValueRangeError, match="points must be at least 2"):
        ClearanceCost(obstacles(), points=1)
    for name in ("radius", "activation", "gain", "self_separation"):
        with pytest.raises(ValueRangeError, match=f"{name} must be positive"):
            ClearanceCost(obstacles(), **{name: -1.0})
    with pytest.raises(ValueRangeError, match="normal must not be zero"):
        HalfSpace(vector(0, 0, 0), vector(0, 0, 0))
    with pytest.raises(ShapeError, match="start must have shape"):
        Sphere(vector(0, 0), 1.0)
