"""The arc against the twist that draws it, its own tangent, and automatic differentiation."""

from __future__ import annotations

import pytest
import torch
from hypothesis import given
from torch import Tensor
from torch.func import jacfwd, jvp

from apcc_torch.lie import se3, so3
from apcc_torch.model.arc import Arc, ArcRate, arc_geometry, arc_pose, arc_rate
from laws import check_bad_row, check_batching, check_gradients, generator, leaves, normal, seeds, uniform

BENDINGS = [1e-8, 1e-6, 1e-4, 1e-3, 0.01, 0.1, 0.5, 1.0, 1.9, 1.999, 2.001, 2.1, 2.5, 3.0]


def bends(seed: int, n: int = 10, largest: float = 3.0) -> tuple[Tensor, Tensor]:
    """Bends (n,) of evenly spread size and direction, rad; the first is straight."""
    rng = generator(seed)
    size = uniform((n,), 0.0, largest, torch.float64, rng)
    size[0] = 0.0
    direction = uniform((n,), -torch.pi, torch.pi, torch.float64, rng)
    return size * direction.cos(), size * direction.sin()


def columns(seed: int, n: int = 10) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Bends and their rates."""
    rng = generator(seed + 1)
    return *bends(seed, n), normal((n,), torch.float64, rng), normal((n,), torch.float64, rng)


@given(seed=seeds)
def test_arc_is_the_exponential_of_its_twist(seed: int) -> None:
    x, y = bends(seed, largest=6.0)
    length = 0.2
    o = torch.zeros_like(x)
    # It turns about (-y, x, 0), across its plane, while moving along its own z axis.
    twist = torch.stack((-y, x, o, o, o, o + length), dim=-1)
    rotation, chord = arc_pose(x, y)
    torch.testing.assert_close(se3.pose(rotation, length * chord), torch.matrix_exp(se3.hat(twist)), rtol=0, atol=2e-14)
    torch.testing.assert_close(so3.exp(twist[:, :3]), rotation, rtol=0, atol=1e-14)


@given(seed=seeds)
def test_tangent_is_the_tip_frames_z_axis(seed: int) -> None:
    x, y = bends(seed)
    fraction = uniform((10,), 0.0, 1.0, torch.float64, generator(seed))
    position, tangent = jvp(lambda s: s[:, None] * arc_pose(s * x, s * y)[1], (fraction,), (torch.ones(10).double(),))
    torch.testing.assert_close(tangent, arc_pose(fraction * x, fraction * y)[0][..., 2], rtol=0, atol=1e-13)
    # A chord of a circle of radius 1 / D, and an arc never longer than its length.
    angle = fraction * torch.hypot(x, y)
    torch.testing.assert_close(position.norm(dim=-1), fraction * torch.sinc(angle / (2 * torch.pi)))


@given(seed=seeds)
def test_rotation_is_a_rotation(seed: int) -> None:
    rotation, _ = arc_pose(*bends(seed, largest=6.0))
    torch.testing.assert_close(rotation @ rotation.mT, torch.eye(3).double().expand(10, 3, 3), rtol=0, atol=1e-14)
    torch.testing.assert_close(torch.linalg.det(rotation), torch.ones(10).double(), rtol=0, atol=1e-14)


@given(seed=seeds)
def test_spin_and_bend_are_the_derivatives_of_the_pose(seed: int) -> None:
    for x, y in zip(*bends(seed, n=3), strict=True):
        theta = torch.stack((x, y))
        arc = arc_geometry(x, y)
        rotation, chord = arc_pose(x, y)
        assert torch.equal(arc.rotation, rotation)
        assert torch.equal(arc.chord, chord)
        slope, bend = jacfwd(lambda t: arc_pose(t[0], t[1]))(theta)
        torch.testing.assert_close(arc.bend, bend, rtol=0, atol=1e-13)
        turning = slope.movedim(-1, 0) @ rotation.mT
        torch.testing.assert_close(so3.hat(arc.spin.mT), turning, rtol=0, atol=1e-13)


@given(seed=seeds)
def test_spin_is_the_left_jacobian(seed: int) -> None:
    x, y = bends(seed)
    omega = torch.stack((-y, x, torch.zeros_like(x)), dim=-1)
    across = torch.tensor([[0.0, -1.0], [1.0, 0.0], [0.0, 0.0]], dtype=torch.float64)
    torch.testing.assert_close(arc_geometry(x, y).spin, so3.left_jacobian(omega) @ across, rtol=0, atol=1e-14)


@given(seed=seeds)
def test_rates_are_the_derivatives_along_the_motion(seed: int) -> None:
    x, y, xdot, ydot = columns(seed)
    _, along = jvp(arc_geometry, (x, y), (xdot, ydot))
    rate = arc_rate(x, y, xdot, ydot)
    torch.testing.assert_close(rate.chord, along.chord, rtol=0, atol=1e-12)
    torch.testing.assert_close(rate.spin, along.spin, rtol=0, atol=1e-12)
    torch.testing.assert_close(rate.bend, along.bend, rtol=0, atol=1e-12)
    torch.testing.assert_close(
        rate.chord, (arc_geometry(x, y).bend @ torch.stack((xdot, ydot), -1)[..., None])[..., 0], rtol=0, atol=1e-13
    )


def test_derivatives_at_the_straight_pose() -> None:
    zero = torch.zeros(2, dtype=torch.float64)
    small = torch.tensor([0.0, 1e-4], dtype=torch.float64)
    for x, y in ((zero, zero), (small, -small), (small + 0.7, small)):
        check_gradients(arc_pose, x, y)
        check_gradients(arc_geometry, x, y)
        check_gradients(lambda x, y: arc_rate(x, y, 0.3 + x, y - 0.8), x, y)


def test_closed_form_at_the_straight_pose() -> None:
    zero = torch.zeros((), dtype=torch.float64)
    arc = arc_geometry(zero, zero)
    assert torch.equal(arc.rotation, torch.eye(3, dtype=torch.float64))
    assert arc.chord.tolist() == [0.0, 0.0, 1.0]
    assert arc.spin.tolist() == [[0.0, -1.0], [1.0, 0.0], [0.0, 0.0]]
    assert arc.bend.tolist() == [[0.5, 0.0], [0.0, 0.5], [0.0, 0.0]]
    # The first terms of u = (x / 2, y / 2, 1 - (x^2 + y^2) / 6).
    rate = arc_rate(zero, zero, zero + 2.0, zero + 3.0)
    assert rate.chord.tolist() == [1.0, 1.5, 0.0]
    torch.testing.assert_close(rate.bend[2], torch.tensor([-2.0, -3.0], dtype=torch.float64) / 3.0)


@pytest.mark.parametrize("bending", BENDINGS)
def test_single_precision_follows_double(bending: float) -> None:
    direction = torch.linspace(0.1, 6.2, 9, dtype=torch.float64)
    x, y = (bending * direction.cos()).float(), (bending * direction.sin()).float()
    xdot, ydot = normal((2, 9), torch.float32, generator(0))
    for single, double in (
        (arc_geometry(x, y), arc_geometry(x.double(), y.double())),
        (arc_rate(x, y, xdot, ydot), arc_rate(x.double(), y.double(), xdot.double(), ydot.double())),
    ):
        for have, want in zip(leaves(single), leaves(double), strict=True):
            # Entry by entry: each is as large as itself over the nine directions, however small the bend makes it.
            error = (have.double() - want).abs().amax(0)
            assert (error <= 1e-4 * want.abs().amax(0)).all()


def test_laws() -> None:
    def bend(shape: tuple[int, ...], dtype: torch.dtype, rng: torch.Generator) -> tuple[Tensor, Tensor]:
        return uniform(shape, -2.0, 2.0, dtype, rng), uniform(shape, -2.0, 2.0, dtype, rng)

    def moving(
        shape: tuple[int, ...], dtype: torch.dtype, rng: torch.Generator
    ) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        return *bend(shape, dtype, rng), *bend(shape, dtype, rng)

    check_batching(arc_pose, bend)
    check_batching(arc_geometry, bend)
    check_batching(arc_rate, moving)
    for op, make in ((arc_pose, bend), (arc_geometry, bend), (arc_rate, moving)):
        check_bad_row(op, make((4,), torch.float32, generator()))
    assert isinstance(arc_geometry(*bend((2,), torch.float32, generator())), Arc)
    assert isinstance(arc_rate(*moving((2,), torch.float32, generator())), ArcRate)
