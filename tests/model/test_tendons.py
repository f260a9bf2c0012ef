"""Tendons against their geometric length along the arm, virtual work, and the limits of friction and slack."""

from __future__ import annotations

import math

import pytest
import torch
from hypothesis import given
from torch import Tensor

from apcc_torch.errors import ConfigError, ShapeError, ValueRangeError
from apcc_torch.model.arc import arc_pose
from apcc_torch.model.friction import TendonTransmission, taut
from apcc_torch.model.tendons import TendonRouting, rack_routing
from laws import check_bad_row, check_batching, check_gradients, generator, normal, seeds, uniform

D = torch.float64
RACKS = torch.tensor([0.105, 0.36, 0.60], dtype=D)
PLANT = torch.tensor([0.0525, 0.0525, 0.1275, 0.1275, 0.12, 0.12], dtype=D)


def arm(seed: int, n_b: int = 6, shape: tuple[int, ...] = (), dtype: torch.dtype = D) -> tuple[Tensor, Tensor]:
    """q and section lengths."""
    rng = generator(seed)
    q = normal((*shape, n_b, 3), D, rng) * torch.tensor([0.4, 0.4, 0.02], dtype=D)
    return q.flatten(-2).to(dtype), uniform((*shape, n_b), 0.06, 0.18, dtype, rng)


def measured_length(q: Tensor, lengths: Tensor, angle: float, offset: float, begin: float, end: float) -> float:
    """Length of a tendon's path, summed over a fine polyline of points fixed in the cross-sections."""
    total = 0.0
    x0 = 0.0
    for i, length in enumerate(lengths.tolist()):
        x, y, stretch = q[3 * i : 3 * i + 3]
        lo, hi = (min(max((a - x0) / length, 0.0), 1.0) for a in (begin, end))
        s = torch.linspace(lo, hi, 2001, dtype=D)
        rotation, chord = arc_pose(s * x, s * y)
        arm = torch.tensor([offset * math.cos(angle), offset * math.sin(angle), 0.0], dtype=D)
        points = s[:, None] * (length + stretch) * chord + rotation @ arm
        total += float(points.diff(dim=0).norm(dim=-1).sum())
        x0 += length
    return total


@pytest.mark.parametrize("layout", ["coupled", "independent"])
def test_lengths_are_the_change_of_the_paths_length(layout: str) -> None:
    routing = rack_routing(torch.tensor([0.1, 0.33, 0.5], dtype=D), layout=layout)
    q, lengths = arm(3)
    y = routing.lengths(q, lengths)
    for k in range(routing.n_tendons):
        path = [float(v[k]) for v in (routing.angles, routing.offsets, routing.starts, routing.anchors)]
        change = measured_length(q, lengths, *path) - measured_length(0.0 * q, lengths, *path)
        assert abs(change - float(y[k])) < 2e-7


def test_paper_tendons() -> None:
    routing = rack_routing(RACKS)
    degrees = torch.rad2deg(routing.angles)
    torch.testing.assert_close(degrees, torch.tensor([0, 120, 240, 30, 150, 270, 60, 180, 300], dtype=D))
    # The racks sit at the ends of sections 2, 4 and 6.
    share = routing.fractions(PLANT)
    for rack, reached in enumerate((2, 4, 6)):
        want = (torch.arange(6) < reached).to(D)
        torch.testing.assert_close(share[:, 3 * rack : 3 * rack + 3], want[:, None].expand(6, 3), rtol=0, atol=1e-14)
    # A row of a fully traversed section, with the sign that pulling (y < 0) shortens or bends towards the tendon.
    first = routing.matrix(PLANT)[:3, 1]
    want = torch.tensor([-0.027 * math.cos(2 * math.pi / 3), -0.027 * math.sin(2 * math.pi / 3), 1.0], dtype=D)
    torch.testing.assert_close(first, want)


def test_independent_layout_acts_between_racks() -> None:
    routing = rack_routing(RACKS, layout="independent")
    share = routing.fractions(PLANT)
    torch.testing.assert_close(share.sum(0), torch.full((9,), 2.0, dtype=D))
    assert share[2:, :3].abs().max() < 1e-14 and share[:2, 3:6].abs().max() < 1e-14


@given(seed=seeds)
def test_anchor_beyond_the_tip_is_held_at_the_tip(seed: int) -> None:
    _, lengths = arm(seed, 3)
    far = rack_routing(torch.tensor([2.0], dtype=D))
    tip = rack_routing(lengths.sum(-1, keepdim=True) * (1 + 1e-9))
    torch.testing.assert_close(far.matrix(lengths), tip.matrix(lengths))


@given(seed=seeds)
def test_generalized_force_does_the_tendons_work(seed: int) -> None:
    routing = rack_routing(RACKS)
    q, lengths = arm(seed, 3)
    u = normal((9,), D, generator(seed))
    work = (routing.generalized_force(u, lengths) * q).sum()
    torch.testing.assert_close(work, (u * routing.lengths(q, lengths)).sum())


def test_matrix_is_differentiable_between_crossings() -> None:
    routing = rack_routing(torch.tensor([0.1, 0.33, 0.5], dtype=D), layout="independent")
    q, lengths = arm(5, 3)
    check_gradients(lambda pi_hat: routing.lengths(q, pi_hat), lengths, second=False)


def test_batching_and_bad_rows() -> None:
    def make(shape: tuple[int, ...], dtype: torch.dtype, rng: torch.Generator) -> tuple[Tensor, Tensor]:
        return arm(int(torch.randint(1000, (), generator=rng)), 3, shape, dtype)

    def op(q: Tensor, lengths: Tensor) -> tuple[Tensor, Tensor]:
        routing = rack_routing(RACKS.to(q.dtype))
        transmission = TendonTransmission(routing, friction=0.2)
        u = torch.linspace(-5, 1, 9, dtype=q.dtype)
        y = routing.lengths(q, lengths)
        return y, transmission(u.expand_as(y), q, q, lengths)

    check_batching(op, make)
    check_bad_row(op, make((3,), D, generator(1)))


def test_bad_input_is_named() -> None:
    one = torch.ones(3, dtype=D)
    with pytest.raises(ConfigError, match="layout"):
        TendonRouting(one, one, one, layout="helical")
    with pytest.raises(ShapeError, match="anchors"):
        TendonRouting(one, one, one[:2])
    with pytest.raises(ValueRangeError, match="offsets"):
        TendonRouting(one, -one, one)
    for name, bad in {"friction": -0.1, "smoothing": float("nan"), "sliding_speed": 0.0}.items():
        with pytest.raises(ValueRangeError, match=f"{name} must be"):
            TendonTransmission(rack_routing(RACKS), **{name: bad})


def test_slack() -> None:
    u = torch.tensor([-3.0, -1e-3, 0.0, 2.0], dtype=D)
    torch.testing.assert_close(taut(u), torch.tensor([-3.0, -1e-3, 0.0, 0.0], dtype=D))
    smooth = taut(u, 1e-2)
    assert (smooth <= 0).all() and (smooth - taut(u)).abs().max() <= 0.5e-2
    check_gradients(lambda v: taut(v, 0.1), u)


def test_frictionless_transmission_is_the_routing() -> None:
    routing = rack_routing(RACKS)
    q, lengths = arm(1, 3)
    u = normal((9,), D, generator(2))
    free = TendonTransmission(routing, slack=False)
    torch.testing.assert_close(free(u, q, q, lengths), routing.generalized_force(u, lengths))
    pulling = TendonTransmission(routing)
    torch.testing.assert_close(pulling(u, q, q, lengths), routing.generalized_force(u.clamp(max=0), lengths))


def test_capstan_friction_against_the_capstan_equation() -> None:
    mu, bend = 0.3, 0.8
    lengths = torch.full((3,), 0.2, dtype=D)
    q = torch.tensor([bend, 0.0, 0.0] * 3, dtype=D)
    routing = TendonRouting(*(torch.tensor([v], dtype=D) for v in (0.0, 0.02, 0.6)))
    transmission = TendonTransmission(routing, friction=mu)
    for direction in (1.0, -1.0):
        share = transmission.tension_share(q, lengths, torch.tensor([direction], dtype=D))[:, 0]
        # dT/dphi = -mu T, averaged over each section by a fine sum.
        phi = torch.linspace(0, bend, 20001, dtype=D)
        mean = torch.exp(-direction * mu * (phi + bend * torch.arange(3)[:, None])).mean(-1)
        torch.testing.assert_close(share, mean, rtol=1e-4, atol=0)
    at_rest = transmission.tension_share(q, lengths, torch.zeros(1, dtype=D))
    torch.testing.assert_close(at_rest, torch.ones(3, 1, dtype=D))
    straight = transmission.tension_share(0.0 * q, lengths, torch.ones(1, dtype=D))
    torch.testing.assert_close(straight, torch.ones(3, 1, dtype=D))


def test_friction_is_differentiable_through_the_straight_pose() -> None:
    transmission = TendonTransmission(rack_routing(RACKS), friction=0.3)
    q, lengths = arm(4, 3)
    u = torch.linspace(-6, -1, 9, dtype=D)
    check_gradients(lambda v: transmission(u, v, q * 1e-3, lengths), q, second=False)
    start = torch.zeros(9, dtype=D, requires_grad=True)
    transmission(u, start, 0.0 * q, lengths).sum().backward()
    assert start.grad is not None and bool(torch.isfinite(start.grad).all())
