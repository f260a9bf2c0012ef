"""Eqs. (14), (16) and (50) against the exact pseudo-inverse and automatic differentiation."""

from __future__ import annotations

import pytest
import torch
from hypothesis import given
from torch import Tensor
from torch.func import grad

from apcc_torch.control.inverse_kinematics import InverseKinematics, elongation_cost, elongation_gradient
from apcc_torch.errors import DtypeError, ShapeError, ValueRangeError
from apcc_torch.linalg import damped_pseudo_inverse
from apcc_torch.model.backbone import PCCBackbone
from arms import PI, configurations
from laws import generator, normal, seeds


def tasks(seed: int, rows: int = 6) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """J, e, xdot_d and q of bent and stretched arms."""
    rng = generator(seed)
    q = configurations((rows,), 3, torch.float64, rng, elongation=0.03)
    e, xdot_d = 0.1 * normal((rows, 3), torch.float64, rng), 0.2 * normal((rows, 3), torch.float64, rng)
    return PCCBackbone(3).tip_jacobian(q, PI), e, xdot_d, q


def apply(matrix: Tensor, vector: Tensor) -> Tensor:
    return (matrix @ vector.unsqueeze(-1)).squeeze(-1)


@given(seed=seeds)
def test_exact_pseudo_inverse(seed: int) -> None:
    J, e, xdot_d, q = tasks(seed)
    pinv = torch.linalg.pinv(J)
    torch.testing.assert_close(damped_pseudo_inverse(J, 0.0), pinv, rtol=1e-9, atol=1e-9)
    root = normal((3, 3), torch.float64, generator(seed))
    K = root @ root.mT + torch.eye(3, dtype=torch.float64)
    qdot = InverseKinematics(K, damping=0.0, null_gain=0.0)(J, e, xdot_d, q)
    torch.testing.assert_close(qdot, apply(pinv, xdot_d + apply(K, e)), rtol=1e-9, atol=1e-9)
    # Eq. (16) as printed.
    qdot = InverseKinematics(K, damping=0.0, null_gain=0.3)(J, e, xdot_d, q)
    lower = -0.3 * elongation_gradient(q, 5e-3)
    projector = torch.eye(9, dtype=torch.float64) - pinv @ J
    torch.testing.assert_close(qdot, apply(pinv, xdot_d + apply(K, e)) + apply(projector, lower), rtol=1e-9, atol=1e-9)


@given(seed=seeds)
def test_damped_pseudo_inverse_is_ridge_regression(seed: int) -> None:
    rng = generator(seed)
    for shape in ((3, 9), (9, 3), (4, 4)):
        J = normal((5, *shape), torch.float64, rng)
        U, S, Vh = torch.linalg.svd(J, full_matrices=False)
        want = Vh.mT @ torch.diag_embed(S / (S**2 + 0.1**2)) @ U.mT
        torch.testing.assert_close(damped_pseudo_inverse(J, 0.1), want, rtol=1e-10, atol=1e-12)


@given(seed=seeds)
def test_null_space_term_lowers_psi_and_leaves_the_tip(seed: int) -> None:
    J, e, xdot_d, q = tasks(seed)
    still = InverseKinematics(damping=0.0, null_gain=0.0)(J, e, xdot_d, q)
    moved = InverseKinematics(damping=0.0, null_gain=0.4)(J, e, xdot_d, q) - still
    torch.testing.assert_close(apply(J, moved), torch.zeros_like(e), rtol=0, atol=1e-10)
    slope = (elongation_gradient(q, 5e-3) * moved).sum(-1)
    assert (slope <= 1e-12).all() and float(slope.min()) < 0.0


def test_null_space_descends_psi_to_a_rest() -> None:
    backbone = PCCBackbone(3)
    q = configurations((), 3, torch.float64, generator(0), elongation=0.03)
    x = backbone.tip(q, PI)
    ik = InverseKinematics(K=5.0, damping=0.0, null_gain=0.2)
    costs = [elongation_cost(q)]
    for _ in range(300):
        tip, J = backbone.tip_and_jacobian(q, PI)
        q = q + 5e-3 * ik(J, x - tip, torch.zeros(3).double(), q)
        costs.append(elongation_cost(q))
    assert float((backbone.tip(q, PI) - x).norm()) < 1e-4
    assert float(costs[-1]) < 0.9 * float(costs[0])
    assert float(torch.stack(costs).diff().max()) < 1e-5


@given(seed=seeds)
def test_elongation_gradient(seed: int) -> None:
    q = configurations((), 4, torch.float64, generator(seed), elongation=0.05)
    torch.testing.assert_close(elongation_gradient(q, 5e-3), grad(lambda q: elongation_cost(q, 5e-3))(q))
    torch.testing.assert_close(elongation_cost(q), q[2::3].norm())
    straight = torch.zeros(12).double()
    assert torch.equal(elongation_gradient(straight, 5e-3), straight)
    assert torch.equal(grad(lambda q: elongation_cost(q, 5e-3))(straight), straight)
    # Smoothing lowers Psi by at most epsilon.
    gap = float(elongation_cost(q) - elongation_cost(q, 5e-3))
    assert 0.0 <= gap <= 5e-3


@given(seed=seeds)
def test_preferred_shape_is_the_descent_of_one_cost(seed: int) -> None:
    J, e, xdot_d, q = tasks(seed)
    rng = generator(seed + 1)
    w, beta = normal((3,), torch.float64, rng).exp(), 0.1 * normal((3,), torch.float64, rng)

    def cost(q: Tensor) -> Tensor:
        bends = q.unflatten(-1, (3, 3))[..., :2]
        return 0.3 * elongation_cost(q, 0.05, weights=w) - 0.5 * (beta * bends.square().sum(-1)).sum()

    ik = InverseKinematics(damping=0.0, null_gain=0.3, epsilon=0.05, null_weights=w, null_bends=beta)
    descent = ik.descent(q)
    torch.testing.assert_close(descent, torch.stack([-grad(cost)(row) for row in q]))
    # It moves what the tip leaves free, and not the tip.
    plain = InverseKinematics(damping=0.0, null_gain=0.0)(J, e, xdot_d, q)
    projector = torch.eye(9, dtype=torch.float64) - torch.linalg.pinv(J) @ J
    moved = ik(J, e, xdot_d, q) - plain
    torch.testing.assert_close(moved, apply(projector, descent), rtol=1e-9, atol=1e-9)
    torch.testing.assert_close(apply(J, moved), torch.zeros_like(e), rtol=0, atol=1e-10)


def test_a_stiff_null_space_does_not_overshoot_its_period() -> None:
    q = configurations((4,), 3, torch.float64, generator(0), elongation=0.002)
    J, e, xdot_d = torch.zeros(4, 3, 9).double(), torch.zeros(4, 3).double(), torch.zeros(4, 3).double()
    dt, shares = torch.tensor(0.02).double(), []
    for step in (None, 0.5):
        w = torch.tensor([1.0, 0.5, 2.0]).double()
        ik = InverseKinematics(damping=1.0, null_gain=10.0, epsilon=0.2, null_weights=w, null_step=step)
        moved = q + dt * ik(J, e, xdot_d, q, dt)
        shares.append(moved[:, 2::3] / q[:, 2::3])
    # Near zero the term is linear: of section 3, 10 m/s 2 / 0.2 m 0.02 s = 2 of its elongation a period.
    wanted = 1.0 - 2.0 * torch.tensor([0.5, 0.25, 1.0]).double()
    torch.testing.assert_close(shares[0], wanted.expand(4, 3), rtol=0, atol=1e-3)
    torch.testing.assert_close(shares[1], 1.0 + (wanted.expand(4, 3) - 1.0) / 4.0, rtol=0, atol=1e-3)
    # Where the term is slow enough, or not held, nothing is changed.
    held = InverseKinematics(null_gain=10.0, epsilon=0.2, null_step=0.5)
    free = InverseKinematics(null_gain=10.0, epsilon=0.2)(J, e, xdot_d, q)
    assert torch.equal(held(J, e, xdot_d, q, 0.4 * dt), free)
    assert torch.equal(held(J, e, xdot_d, q, 0.0 * dt), free)
    assert torch.equal(held(J, e, xdot_d, q), free)


def test_bends_grow_or_shrink_where_the_tip_leaves_them_free() -> None:
    backbone = PCCBackbone(3)
    start = configurations((), 3, torch.float64, generator(0), elongation=0.02)
    x = backbone.tip(start, PI)
    last = []
    for beta in (-1.0, 0.0, 0.5):
        q = start
        ik = InverseKinematics(5.0, null_gain=0.2, null_bends=torch.tensor([0.0, 0.0, beta]).double())
        for _ in range(200):
            tip, J = backbone.tip_and_jacobian(q, PI)
            q = q + 5e-3 * ik(J, x - tip, torch.zeros(3).double(), q)
        assert float((backbone.tip(q, PI) - x).norm()) < 1e-3
        last.append(float(q[6:8].norm()))
    assert last[0] < last[1] < last[2]


@given(seed=seeds)
def test_the_null_space_rests_with_the_tip(seed: int) -> None:
    J, e, xdot_d, q = tasks(seed)
    shape = {"K": 1.5, "damping": 0.0, "null_gain": 0.3, "null_bends": torch.tensor([0.2, -0.1, 0.3]).double()}
    plain, held = InverseKinematics(**shape), InverseKinematics(**shape, null_speed=0.02)  # type: ignore[arg-type]
    share = 1.0 / (1.0 + (0.02 / (xdot_d + 1.5 * e).norm(dim=-1, keepdim=True)) ** 2)
    task = InverseKinematics(1.5, damping=0.0, null_gain=0.0)(J, e, xdot_d, q)
    torch.testing.assert_close(held(J, e, xdot_d, q) - task, share * (plain(J, e, xdot_d, q) - task))
    # A tip that follows a moving target without error is not at rest.
    still = torch.zeros_like(e)
    assert torch.equal(held(J, still, still, q), still.new_zeros(q.shape))
    assert not torch.allclose(held(J, still, xdot_d, q), task)


def test_what_an_arm_does_not_follow_winds_up_unless_the_null_space_rests() -> None:
    # An arm that stands still where it is, stretched.
    backbone, q = PCCBackbone(3), configurations((), 3, torch.float64, generator(0), elongation=0.03)
    J, still = backbone.tip_jacobian(q, PI), torch.zeros(3).double()
    away = []
    for speed in (None, 1e-3):
        ik, q_d, times = InverseKinematics(null_gain=0.1, null_speed=speed), q, []
        for _ in range(1500):
            q_d = q_d + 0.02 * ik(J, still, still, q)
            times.append(float((q_d - q).norm()))
        away.append((times[749], times[-1]))
    assert away[0][1] == pytest.approx(2.0 * away[0][0]) and away[0][1] > 0.5  # after 15 and 30 s
    assert away[1] == (0.0, 0.0)


@given(seed=seeds)
def test_speed_bounds_scale_whole_rows(seed: int) -> None:
    J, e, xdot_d, q = tasks(seed)
    free = InverseKinematics(null_gain=0.05)(J, e, xdot_d, q)
    peak = free.unflatten(-1, (3, 3)).abs().amax(-2)
    bend, length = float(peak[..., :2].max()) / 2.0, float(peak[..., 2].max()) / 3.0
    for settings in ({"bend_rate": bend}, {"length_rate": length}, {"bend_rate": bend, "length_rate": length}):
        qdot = InverseKinematics(null_gain=0.05, **settings)(J, e, xdot_d, q)
        bounded = qdot.unflatten(-1, (3, 3)).abs().amax(-2)
        assert float(bounded[..., :2].max()) <= settings.get("bend_rate", torch.inf) * (1 + 1e-12)
        assert float(bounded[..., 2].max()) <= settings.get("length_rate", torch.inf) * (1 + 1e-12)
        scale = (qdot * free).sum(-1) / free.square().sum(-1)
        torch.testing.assert_close(qdot, scale.unsqueeze(-1) * free, rtol=1e-9, atol=1e-12)
        assert (scale <= 1.0 + 1e-12).all() and float(scale.min()) < 1.0
        within = (peak[..., :2].amax(-1) <= settings.get("bend_rate", torch.inf)) & (
            peak[..., 2] <= settings.get("length_rate", torch.inf)
        )
        assert torch.equal(qdot[within], free[within])


def test_damping_bounds_the_singular_arm() -> None:
    # A straight arm cannot be bent towards its own axis faster than it can be stretched; one without freedom stands.
    J = torch.zeros(3, 9).double()
    qdot = InverseKinematics(damping=1e-3, null_gain=0.0)(J, torch.ones(3).double(), torch.ones(3).double(), J[0])
    assert torch.equal(qdot, torch.zeros(9).double())


def test_gains_differ_by_row() -> None:
    J, e, xdot_d, q = tasks(1, rows=2)
    K = torch.stack((torch.eye(3), 4.0 * torch.eye(3))).double()
    both = InverseKinematics(K, null_gain=0.05)(J, e, xdot_d, q)
    for row, gain in enumerate((1.0, 4.0)):
        one = InverseKinematics(gain, null_gain=0.05)(J[row], e[row], xdot_d[row], q[row])
        torch.testing.assert_close(both[row], one)


def test_refusals() -> None:
    with pytest.raises(ValueRangeError, match="K must be positive and finite"):
        InverseKinematics(K=-1.0)
    for name in ("damping", "null_gain", "epsilon", "bend_rate", "length_rate"):
        for value in (-1.0, float("nan"), float("inf")):
            with pytest.raises(ValueRangeError, match=name):
                InverseKinematics(**{name: value})
    with pytest.raises(ValueRangeError, match="epsilon must be positive"):
        InverseKinematics(epsilon=0.0)
    for value in ([1.0, -1.0, 1.0], [1.0, float("nan"), 1.0]):
        with pytest.raises(ValueRangeError, match="null_weights must be zero or positive"):
            InverseKinematics(null_weights=torch.tensor(value))
    with pytest.raises(ValueRangeError, match=r"null_bends must be finite, got inf"):
        InverseKinematics(null_bends=torch.tensor([0.0, float("inf"), 0.0]))
    ik = InverseKinematics()
    J, e, xdot_d, q = tasks(0)
    for name in ("null_weights", "null_bends"):
        with pytest.raises(ShapeError, match=rf"{name} must have shape \(\.\.\., 3\), got \(2,\)"):
            InverseKinematics(**{name: torch.ones(2).double()})(J, e, xdot_d, q)
    with pytest.raises(ShapeError, match="J_hat must have shape"):
        ik(J[:, :2], e, xdot_d, q)
    with pytest.raises(ShapeError, match="e must have shape"):
        ik(J, e[:, :2], xdot_d, q)
    with pytest.raises(ShapeError, match="q must have shape"):
        ik(J, e, xdot_d, q[:, :6])
    with pytest.raises(DtypeError, match=r"xdot_d is torch\.float32"):
        ik(J, e, xdot_d.float(), q)
