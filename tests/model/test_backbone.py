"""The backbone against its own tangent, automatic differentiation and closed forms."""

from __future__ import annotations

from collections.abc import Callable

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from torch import Tensor
from torch.func import jacfwd, jvp

from apcc_torch.errors import DtypeError, ShapeError, ValueRangeError
from apcc_torch.lie import se3
from apcc_torch.model.abscissae import decouple
from apcc_torch.model.backbone import PCCBackbone
from arms import HANGING_BASE, configurations, rest_lengths
from laws import check_gradients, generator, normal, rotations, seeds, uniform

BENDINGS = [1e-8, 1e-6, 1e-4, 1e-2, 0.3, 1.0, 2.0, 3.0]
sections = st.integers(1, 6)


def random_arm(seed: int, n: int) -> tuple[PCCBackbone, Tensor, Tensor]:
    """A backbone on a random base, q and L0."""
    rng = generator(seed)
    base = rotations((), torch.float64, rng)
    return PCCBackbone(n, base), configurations((), n, torch.float64, rng), rest_lengths((), n, torch.float64, rng)


def along(L0: Tensor, k: int, seed: int) -> Tensor:
    """k material abscissae inside the arm, in order, m."""
    return (uniform((k,), 0.01, 0.99, L0.dtype, generator(seed)) * L0.sum()).sort().values


@given(seed=seeds, n=sections)
def test_tangent_is_the_frames_z_axis_along_the_whole_arm(seed: int, n: int) -> None:
    backbone, q, L0 = random_arm(seed, n)
    X = along(L0, 20, seed)
    pose, rate = jvp(lambda X: backbone.pose(q, L0, *decouple(X, L0)), (X,), (torch.ones_like(X),))
    _, j = decouple(X, L0)
    stretch = (1.0 + q[2::3] / L0)[j]  # metres of arm per metre of rest length
    torch.testing.assert_close(rate[:, :3, 3], stretch[:, None] * pose[:, :3, 2], rtol=0, atol=1e-12)
    # No shear, no twist: the frame turns about axes across the tangent only.
    turning = se3.vee(se3.inverse(pose) @ rate)
    torch.testing.assert_close(turning[:, 2], torch.zeros(20).double(), rtol=0, atol=1e-12)


@given(seed=seeds, n=st.integers(2, 6))
def test_sections_meet_with_one_tangent(seed: int, n: int) -> None:
    backbone, q, L0 = random_arm(seed, n)
    joint = torch.arange(n - 1)
    ending = backbone.pose(q, L0, torch.ones(n - 1).double(), joint)
    starting = backbone.pose(q, L0, torch.zeros(n - 1).double(), joint + 1)
    torch.testing.assert_close(ending, starting, rtol=0, atol=1e-14)
    # Finite differences across the joint see that tangent on both sides.
    h = 1e-6
    X = L0.cumsum(0)[:-1]
    before, at, after = (backbone.pose(q, L0, *decouple(X + d, L0))[:, :3] for d in (-h, 0.0, h))
    stretch = 1.0 + q[2::3] / L0
    for step, part in ((at - before, stretch[:-1]), (after - at, stretch[1:])):
        torch.testing.assert_close(step[..., 3] / h, part[:, None] * at[..., 2], rtol=0, atol=1e-4)


@given(seed=seeds, n=sections)
def test_tip_and_pose_and_points_are_one_curve(seed: int, n: int) -> None:
    backbone, q, L0 = random_arm(seed, n)
    end = backbone.pose(q, L0, torch.ones(1).double(), torch.tensor([n - 1]))[0]
    torch.testing.assert_close(end[:3, 3], backbone.tip(q, L0), rtol=0, atol=1e-14)
    torch.testing.assert_close(end[:3, :3] @ end[:3, :3].mT, torch.eye(3).double(), rtol=0, atol=1e-13)
    together = backbone.tip_and_jacobian(q, L0)
    assert torch.equal(together[0], backbone.tip(q, L0)) and torch.equal(together[1], backbone.tip_jacobian(q, L0))
    X = along(L0, 7, seed)
    where = decouple(X, L0)
    pose, body = backbone.pose_and_body_jacobian(q, L0, *where)
    torch.testing.assert_close(pose, backbone.pose(q, L0, *where), rtol=0, atol=1e-14)
    assert torch.equal(body, backbone.body_jacobian(q, L0, *where))
    material = backbone.points(q, L0, 11, "material")
    spaced = torch.linspace(0.0, 1.0, 11, dtype=torch.float64) * L0.sum()
    torch.testing.assert_close(material, backbone.pose(q, L0, *decouple(spaced, L0))[:, :3, 3], rtol=0, atol=1e-14)
    for points in (material, backbone.points(q, L0, 11)):
        torch.testing.assert_close(points[0], torch.zeros(3).double(), rtol=0, atol=1e-15)
        torch.testing.assert_close(points[-1], backbone.tip(q, L0), rtol=0, atol=1e-14)


@given(seed=seeds, n=sections)
def test_arc_points_are_even_along_the_curve_and_depend_on_it_alone(seed: int, n: int) -> None:
    backbone, q, L0 = random_arm(seed, n)
    N = 2001
    points = backbone.points(q, L0, N)
    step = float((L0 + q[2::3]).sum()) / (N - 1)
    chords = points.diff(dim=0).norm(dim=-1)
    torch.testing.assert_close(chords, torch.full_like(chords, step), rtol=1e-5, atol=0)
    # The same curve from other numbers: elongation taken for rest length, every section cut in two.
    firm = q.clone()
    firm[2::3] = 0.0
    torch.testing.assert_close(backbone.points(firm, L0 + q[2::3], N), points, rtol=0, atol=1e-12)
    halves = PCCBackbone(2 * n, backbone.base_rotation)
    cut = (q.unflatten(-1, (n, 3)) / 2.0).repeat_interleave(2, dim=0).flatten()
    torch.testing.assert_close(halves.points(cut, (L0 / 2.0).repeat_interleave(2), N), points, rtol=0, atol=1e-12)


def test_hanging_arm() -> None:
    backbone = PCCBackbone(3, HANGING_BASE)
    L0 = torch.tensor([0.1, 0.2, 0.3], dtype=torch.float64)
    straight = torch.zeros(9).double()
    torch.testing.assert_close(backbone.tip(straight, L0), torch.tensor([0.0, 0.0, -0.6], dtype=torch.float64))
    points = backbone.points(straight, L0, 7)
    torch.testing.assert_close(points[:, 2], -torch.linspace(0.0, 0.6, 7, dtype=torch.float64))
    assert float(points[:, :2].abs().max()) == 0.0
    # The base frame is turned about x: bends along x stay, bends along y and the arm itself change sides.
    standing = PCCBackbone(3)
    q = configurations((), 3, torch.float64, generator(0))
    flip = torch.tensor([1.0, -1.0, -1.0]).double()
    torch.testing.assert_close(backbone.tip(q, L0), flip * standing.tip(q, L0))
    assert float(backbone.tip(torch.tensor([0.3, 0, 0] * 3).double(), L0)[0]) > 0.0


@given(seed=seeds, n=sections)
def test_jacobians_are_the_derivatives(seed: int, n: int) -> None:
    backbone, q, L0 = random_arm(seed, n)
    torch.testing.assert_close(backbone.tip_jacobian(q, L0), jacfwd(backbone.tip)(q, L0), rtol=0, atol=1e-12)
    where = decouple(along(L0, 4, seed), L0)
    pose = backbone.pose(q, L0, *where)
    slope = jacfwd(lambda q: backbone.pose(q, L0, *where))(q)  # (k, 4, 4, n)
    twist = se3.vee(se3.inverse(pose)[:, None] @ slope.movedim(-1, 1))  # (k, n, 6)
    torch.testing.assert_close(backbone.body_jacobian(q, L0, *where), twist.mT, rtol=0, atol=1e-12)


@given(seed=seeds, n=sections)
def test_parameter_jacobian_moves_the_abscissae_too(seed: int, n: int) -> None:
    backbone, q, L0 = random_arm(seed, n)
    # The last two sensors lie beyond the model's tip and are attached to it.
    X = torch.cat((along(L0, 4, seed), L0.sum() + torch.tensor([0.01, 0.2]).double()))
    where = decouple(X, L0)
    pose, body = backbone.pose_and_body_jacobian(q, L0, *where)
    slope = jacfwd(lambda L0: backbone.pose(q, L0, *decouple(X, L0)))(L0)
    twist = se3.vee(se3.inverse(pose)[:, None] @ slope.movedim(-1, 1))
    torch.testing.assert_close(backbone.body_parameter_jacobian(q, L0, X, body), twist.mT, rtol=0, atol=1e-12)


def test_sensor_on_the_very_tip_counts_as_inside() -> None:
    # Which side a sensor at the end of the arm is taken for must not hang on the rounding of a sum.
    rng = generator(3)
    for n in range(1, 7):
        backbone = PCCBackbone(n)
        L0 = rest_lengths((50,), n, torch.float64, rng)
        q = configurations((50,), n, torch.float64, rng)
        X = L0.cumsum(-1)[:, -1:]
        body = backbone.body_jacobian(q, L0, *decouple(X, L0))
        inside = backbone.body_parameter_jacobian(q, L0, X, body)
        nearly = backbone.body_parameter_jacobian(q, L0, X - 1e-12, body)
        torch.testing.assert_close(inside, nearly, rtol=0, atol=1e-9)


@given(seed=seeds, n=sections)
def test_jacobian_rate(seed: int, n: int) -> None:
    backbone, q, L0 = random_arm(seed, n)
    qdot = normal((3 * n,), torch.float64, generator(seed))
    rate = backbone.tip_jacobian_rate(q, qdot, L0)
    _, along_motion = jvp(lambda q: jacfwd(backbone.tip)(q, L0), (q,), (qdot,))
    torch.testing.assert_close(rate, along_motion, rtol=0, atol=1e-11)
    velocity_slope = jacfwd(lambda q: jacfwd(backbone.tip)(q, L0) @ qdot)(q)
    torch.testing.assert_close(rate, velocity_slope, rtol=0, atol=1e-11)


def test_arguments_broadcast() -> None:
    rng = generator(1)
    backbone = PCCBackbone(3)
    q = configurations((4, 1), 3, torch.float64, rng)
    L0 = rest_lengths((5,), 3, torch.float64, rng)
    X = torch.tensor([0.05, 0.2]).double()
    qdot = normal((2, 1, 1, 9), torch.float64, rng)
    where = decouple(X, L0)
    full, rest = q.expand(4, 5, 9), L0.expand(4, 5, 3)
    assert torch.equal(backbone.tip(q, L0), backbone.tip(full, rest))
    assert torch.equal(backbone.points(q, L0, 5), backbone.points(full, rest, 5))
    assert torch.equal(backbone.pose(q, L0, *where), backbone.pose(full, rest, *decouple(X, rest)))
    body = backbone.body_jacobian(q, L0, *where)
    assert torch.equal(body, backbone.body_jacobian(full, rest, *decouple(X, rest)))
    parameters = backbone.body_parameter_jacobian(q, L0, X, body)
    assert torch.equal(parameters, backbone.body_parameter_jacobian(full, rest, X, body))
    for one in range(4):
        each = backbone.body_parameter_jacobian(full[one], rest[one], X, body[one])
        torch.testing.assert_close(parameters[one], each, rtol=0, atol=1e-14)
    rates = backbone.tip_jacobian_rate(q, qdot, L0)
    assert rates.shape == (2, 4, 5, 3, 9)
    torch.testing.assert_close(rates[1], backbone.tip_jacobian_rate(full, qdot[1].expand(4, 5, 9), rest))


def test_derivatives_at_the_straight_pose() -> None:
    backbone = PCCBackbone(2, HANGING_BASE)
    L0 = torch.tensor([0.1, 0.2]).double()
    X_tilde, j = torch.tensor([0.5]).double(), torch.tensor([1])
    straight, nearly = torch.zeros(6).double(), torch.tensor([1e-4, 0, 0, 0, -1e-4, 0]).double()
    check_gradients(backbone.tip_jacobian, nearly, L0)
    check_gradients(backbone.tip, straight, L0)
    check_gradients(lambda q, L0: backbone.pose(q, L0, X_tilde, j)[..., :3, :], straight, L0)
    check_gradients(backbone.tip_jacobian, straight, L0)
    check_gradients(lambda q, L0: backbone.body_jacobian(q, L0, X_tilde, j), straight, L0)
    check_gradients(lambda q, L0: backbone.tip_jacobian_rate(q, torch.arange(6).double(), L0), straight, L0)


def test_closed_form_at_the_straight_pose() -> None:
    # A section of length L turned by a small angle moves what is beyond by that angle times its distance from mid-arc.
    backbone = PCCBackbone(2)
    a, b = 0.1, 0.3
    J = backbone.tip_jacobian(torch.zeros(6).double(), torch.tensor([a, b], dtype=torch.float64))
    across = torch.tensor([a / 2 + b, 0.0, 0.0, b / 2, 0.0, 0.0], dtype=torch.float64)
    want = torch.stack((across, across.roll(1), torch.tensor([0, 0, 1, 0, 0, 1]).double()))
    torch.testing.assert_close(J, want, rtol=0, atol=1e-16)


@pytest.mark.parametrize("bending", BENDINGS)
def test_single_precision_follows_double(bending: float) -> None:
    backbone = PCCBackbone(3, HANGING_BASE)
    direction = torch.linspace(0.1, 6.2, 9, dtype=torch.float64)
    q = torch.zeros(9, 3, 3, dtype=torch.float64)
    q[..., 0], q[..., 1] = bending * direction.cos()[:, None], bending * direction.sin()[:, None]
    q[..., 2] = 0.01
    single = q.flatten(1).float()
    L0, X = torch.tensor([0.1, 0.25, 0.24]), torch.tensor([0.05, 0.2, 0.5])
    where = decouple(X, L0)
    qdot = normal((9, 9), torch.float32, generator(0))
    ops: list[Callable[..., Tensor]] = [
        lambda q, L0, qdot, X_tilde: backbone.tip(q, L0),
        lambda q, L0, qdot, X_tilde: backbone.tip_jacobian(q, L0),
        lambda q, L0, qdot, X_tilde: backbone.pose(q, L0, X_tilde, where[1]),
        lambda q, L0, qdot, X_tilde: backbone.body_jacobian(q, L0, X_tilde, where[1]),
        lambda q, L0, qdot, X_tilde: backbone.regressor(q, qdot)[0],
        lambda q, L0, qdot, X_tilde: backbone.regressor(q, qdot)[1],
        lambda q, L0, qdot, X_tilde: backbone.tip_jacobian_rate(q, qdot, L0),
    ]
    for k, op in enumerate(ops):
        have = op(single, L0, qdot, where[0])
        want = op(single.double(), L0.double(), qdot.double(), where[0].double())
        assert have.dtype == torch.float32
        # Entry by entry: each is as large as itself over the nine directions, however small the bend makes it; what
        # is zero by symmetry may differ by the rounding of the terms that cancel in it.
        error, scale = (have.double() - want).abs().amax(0), want.abs().amax(0)
        assert (error <= 1e-4 * scale + 1e-7 * bending * scale.max()).all(), f"operation {k}"


def test_refusals() -> None:
    backbone = PCCBackbone(3)
    q, L0 = torch.zeros(9).double(), torch.full((3,), 0.1).double()
    X_tilde, j = torch.ones(2).double(), torch.tensor([0, 1])
    with pytest.raises(ValueRangeError, match="n_sections"):
        PCCBackbone(0)
    with pytest.raises(ShapeError, match="base_rotation must have shape"):
        PCCBackbone(3, torch.eye(4))
    for wrong in (2.0 * torch.eye(3), -torch.eye(3), torch.full((3, 3), torch.nan)):
        with pytest.raises(ValueRangeError, match="base_rotation"):
            PCCBackbone(3, wrong)
    with pytest.raises(ShapeError, match=r"q must have shape \(\.\.\., 9\), got \(8,\)"):
        backbone.tip(q[:8], L0)
    with pytest.raises(ShapeError, match="L0 must have shape"):
        backbone.tip_jacobian(q, L0[:2])
    with pytest.raises(DtypeError, match=r"q is torch.float64 but L0 is torch.float32"):
        backbone.tip(q, L0.float())
    with pytest.raises(DtypeError, match="q must be a floating-point tensor"):
        backbone.tip(q.long(), L0)
    with pytest.raises(ShapeError, match=r"do not broadcast: q \(2,\), L0 \(3,\)"):
        backbone.tip(q.expand(2, 9), L0.expand(3, 3))
    with pytest.raises(ShapeError, match="qdot must have shape"):
        backbone.regressor(q, q[:3])
    with pytest.raises(DtypeError, match="qdot"):
        backbone.tip_jacobian_rate(q, q.float(), L0)
    with pytest.raises(ShapeError, match="do not broadcast"):
        backbone.regressor(q.expand(2, 9), q.expand(3, 9))
    with pytest.raises(DtypeError, match=r"j must be torch.int64"):
        backbone.pose(q, L0, X_tilde, j.int())
    with pytest.raises(ShapeError, match="j must have shape"):
        backbone.pose(q, L0, X_tilde, j[:1])
    with pytest.raises(DtypeError, match="X_tilde"):
        backbone.body_jacobian(q, L0, X_tilde.float(), j)
    with pytest.raises(ShapeError, match="do not broadcast"):
        backbone.body_jacobian(q.expand(2, 9), L0, X_tilde.expand(3, 2), j)
    with pytest.raises(ValueRangeError, match="N must be at least 2"):
        backbone.points(q, L0, 1)
    with pytest.raises(ValueRangeError, match="spacing must be arc or material"):
        backbone.points(q, L0, 5, "even")
