"""Stacks of tasks against the inverse kinematics they generalise, and against least squares solved another way."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from scipy.optimize import lsq_linear
from torch import Tensor
from torch.autograd.functional import jacobian

from apcc_torch.control.bounds import RateBounds
from apcc_torch.control.clearance import ClearanceCost
from apcc_torch.control.inverse_kinematics import InverseKinematics
from apcc_torch.control.obstacles import HalfSpace, Sphere
from apcc_torch.control.task_stack import TaskStack
from apcc_torch.control.tasks import Task, TaskRate, TaskTarget
from apcc_torch.errors import ShapeError, ValueRangeError
from apcc_torch.model.affine import AffineBackbone
from apcc_torch.model.backbone import PCCBackbone
from apcc_torch.model.constant_strain import ConstantStrainBackbone
from apcc_torch.model.kinematic_model import KinematicModel
from apcc_torch.model.mount import MountedArm, RigidMount
from arms import HANGING_BASE, configurations, rest_lengths
from laws import check_bad_row, check_batching, generator, normal, seeds, uniform

BACKBONE = PCCBackbone(3, HANGING_BASE)


def rate(J: Tensor, velocity: Tensor, weight: float = 1.0) -> TaskRate:
    return TaskRate(J, velocity, torch.zeros_like(velocity), torch.full_like(velocity, weight))


def arms(rng: torch.Generator, rows: int = 5) -> tuple[Tensor, Tensor]:
    return configurations((rows,), 3, torch.float64, rng), rest_lengths((rows,), 3, torch.float64, rng)


@given(seed=seeds)
@settings(max_examples=25)
def test_one_tip_task_is_the_inverse_kinematics(seed: int) -> None:
    rng = generator(seed)
    q, L0 = arms(rng)
    x_d, xdot_d = normal((5, 3), torch.float64, rng) * 0.3, normal((5, 3), torch.float64, rng)
    K = torch.diag(uniform((3,), 0.5, 3.0, torch.float64, rng))
    solver = InverseKinematics(K, damping=2e-3, null_gain=0.4)
    stack = TaskStack([Task(gain=K)], damping=2e-3)
    qdot = stack(stack.rates(BACKBONE, q, L0, [TaskTarget(x_d, xdot_d)]), solver.descent(q))
    want = solver(BACKBONE.tip_jacobian(q, L0), x_d - BACKBONE.tip(q, L0), xdot_d, q)
    torch.testing.assert_close(qdot, want, rtol=1e-12, atol=1e-12)


def test_tasks_of_one_level_are_weighted_least_squares() -> None:
    rng = generator(1)
    J, v = normal((12, 9), torch.float64, rng), normal((12,), torch.float64, rng)
    parts = [rate(J[:4], v[:4], 1.0), rate(J[4:8], v[4:8], 3.0), rate(J[8:], v[8:], 0.5)]
    have = TaskStack([Task(), Task(), Task()], damping=0.0)(parts)
    w = np.repeat([1.0, 3.0, 0.5], 4)
    want = np.linalg.lstsq(w[:, None] * J.numpy(), w * v.numpy(), rcond=None)[0]
    np.testing.assert_allclose(have.numpy(), want, rtol=1e-9)


@given(seed=seeds)
@settings(max_examples=25)
def test_priorities_are_nested_least_squares(seed: int) -> None:
    rng = generator(seed)
    n, sizes = 9, (3, 3, 6)
    parts = [rate(normal((m, n), torch.float64, rng), normal((m,), torch.float64, rng)) for m in sizes]
    stack = TaskStack([Task(level=5), Task(level=-1), Task(level=9)], damping=1e-4)
    # Given in another order than their priority: 1 first, then 0, then 2, of which only 3 rows can be met.
    have = stack([parts[0], parts[1], parts[2]]).numpy()
    first = np.concatenate([parts[1].J.numpy(), parts[0].J.numpy()])
    meets = np.linalg.lstsq(first, np.concatenate([parts[1].velocity, parts[0].velocity]), rcond=None)[0]
    free = np.linalg.svd(first)[2][6:].T
    J, v = parts[2].J.numpy(), parts[2].velocity.numpy()
    want = meets + free @ np.linalg.lstsq(J @ free, v - J @ meets, rcond=None)[0]
    np.testing.assert_allclose(have, want, rtol=1e-3, atol=1e-4 * np.abs(want).max())


def test_conflict_costs_the_lower_level_alone() -> None:
    rng = generator(2)
    J, v = normal((3, 9), torch.float64, rng), normal((3,), torch.float64, rng)
    other = normal((3,), torch.float64, rng)
    stack = TaskStack([Task(level=1), Task(level=0)])
    qdot = stack([rate(J, other), rate(J, v)])
    torch.testing.assert_close(J @ qdot, v, rtol=0, atol=1e-4)
    shared = TaskStack([Task(), Task()], damping=1e-3)([rate(J, other, 2.0), rate(J, v)])
    torch.testing.assert_close(J @ shared, 0.8 * other + 0.2 * v, rtol=0, atol=1e-5)


def test_the_null_space_does_not_disturb_the_tasks() -> None:
    rng = generator(3)
    J, v, descent = (normal(s, torch.float64, rng) for s in ((4, 3, 9), (4, 3), (4, 9)))
    stack = TaskStack([Task()], damping=0.0)
    moved, still = stack([rate(J, v)], descent), stack([rate(J, v)])
    torch.testing.assert_close((J @ (moved - still).unsqueeze(-1)).squeeze(-1), torch.zeros(4, 3).double())
    # Of all motions that leave the task alone it is the nearest to the descent.
    basis = torch.linalg.svd(J)[2][..., 3:, :]
    want = (basis.mT @ basis @ descent.unsqueeze(-1)).squeeze(-1)
    torch.testing.assert_close(moved - still, want)


def test_coordinate_weights_are_a_metric() -> None:
    rng = generator(4)
    J, v = normal((3, 9), torch.float64, rng), normal((3,), torch.float64, rng)
    w = uniform((9,), 0.2, 5.0, torch.float64, rng)
    have = TaskStack([Task()], damping=0.0, coordinate_weights=w)([rate(J, v)])
    # The least of qdot' W qdot in J qdot = v, by Lagrange's equations.
    system = torch.zeros(12, 12, dtype=torch.float64)
    system[:9, :9], system[:9, 9:], system[9:, :9] = torch.diag(w), J.mT, J
    want = torch.linalg.solve(system, torch.cat((torch.zeros(9).double(), v)))[:9]
    torch.testing.assert_close(have, want)


@given(seed=seeds)
@settings(max_examples=25)
def test_bounds_hold_and_the_rest_makes_up(seed: int) -> None:
    rng = generator(seed)
    J, v = normal((1, 3, 9), torch.float64, rng), normal((1, 3), torch.float64, rng)
    stack = TaskStack([Task()], damping=1e-6)
    free = stack([rate(J, v)])
    limit = torch.full((1, 9), torch.inf).double()
    worst = int(free.abs().argmax())
    limit[0, worst] = 0.5 * free.abs().max()
    bounded = stack([rate(J, v)], bounds=RateBounds(-limit, limit))
    assert bool((bounded.abs() <= limit).all())
    torch.testing.assert_close((J @ bounded.unsqueeze(-1)).squeeze(-1), v, rtol=0, atol=1e-5)
    # All bounded: never better than the bounded least squares, and inside.
    tight = torch.full((1, 9), 0.3 * float(free.abs().max())).double()
    inside = stack([rate(J, v)], bounds=RateBounds(-tight, tight))
    assert bool((inside.abs() <= tight).all())
    best = lsq_linear(J[0].numpy(), v[0].numpy(), (-tight[0].numpy(), tight[0].numpy()))
    left = float((J @ inside.unsqueeze(-1)).squeeze(-1).sub(v).square().sum())
    assert left >= 2.0 * best.cost - 1e-9


def test_leading_dimensions_are_a_batch() -> None:
    def solve(q: Tensor, L0: Tensor, x_d: Tensor, descent: Tensor) -> Tensor:
        stack = TaskStack([Task(), Task("direction", 0.2, level=1)], damping=1e-2)
        down = torch.tensor([0.0, 0.0, -1.0], dtype=q.dtype)
        rates = stack.rates(BACKBONE, q, L0, [TaskTarget(x_d), TaskTarget(direction=down)])
        limit = torch.full_like(descent, 0.5)
        return stack(rates, descent, RateBounds(-limit, limit))

    def inputs(shape: tuple[int, ...], dtype: torch.dtype, rng: torch.Generator) -> tuple[Tensor, ...]:
        q, L0 = configurations(shape, 3, dtype, rng), rest_lengths(shape, 3, dtype, rng)
        return q, L0, normal((*shape, 3), dtype, rng) * 0.1, normal((*shape, 9), dtype, rng) * 0.1

    check_batching(solve, inputs, dtypes=(torch.float64,))
    check_bad_row(solve, inputs((3,), torch.float64, generator(5)))


def test_what_is_given_once_serves_all_rows() -> None:
    rng = generator(7)
    q, L0 = arms(rng)
    stack = TaskStack([Task("pose", weight=torch.ones(5).double()), Task("direction", 0.2, level=1), Task()])
    x_d, R_d = normal((5, 3), torch.float64, rng) * 0.1, HANGING_BASE
    down = torch.tensor([0.0, 0.0, -1.0], dtype=torch.float64)
    targets = [TaskTarget(x_d, R_d=R_d, omega_d=down), TaskTarget(direction=down), TaskTarget(x_d[0])]
    many = stack(stack.rates(BACKBONE, q[0], L0[0], targets))
    for i in range(5):
        here = [targets[0]._replace(x_d=x_d[i]), *targets[1:]]
        one = TaskStack([Task("pose"), Task("direction", 0.2, level=1), Task()])
        torch.testing.assert_close(many[i], one(one.rates(BACKBONE, q[0], L0[0], here)))


def test_a_whole_body_stays_on_its_device() -> None:
    # torch's meta device has shapes but no values: mixing devices or reading a value fails on it.
    meta = torch.device("meta")
    gantry = Path(__file__).parents[2] / "examples" / "urdf" / "gantry.urdf"
    body = MountedArm(RigidMount(gantry, "flange"), PCCBackbone(3)).to(meta)
    s, L0 = (torch.zeros(4, n, dtype=torch.float64, device=meta) for n in (13, 3))
    stack = TaskStack([Task("pose"), Task("direction", 0.3, level=1)], coordinate_weights=torch.ones(13)).to(meta)
    turn = torch.zeros(3, 3, dtype=torch.float64, device=meta)
    target = TaskTarget(s[:, :3], R_d=turn, direction=s[:, :3])
    wall = HalfSpace(torch.zeros(3), torch.ones(3))
    cost = ClearanceCost([Sphere(torch.zeros(3), 1.0), wall], self_separation=0.2).to(meta)
    rates = stack.rates(body, s, L0, [target, target])
    sdot = stack(rates, cost.descent(body, s, L0), RateBounds(*body.rate_bounds(s, 0.1)))
    assert sdot.device == meta and sdot.shape == (4, 13)
    assert cost.clearance(body, s, L0).self.device == meta


@pytest.mark.parametrize("model", [AffineBackbone(2), ConstantStrainBackbone(2)], ids=lambda m: type(m).__name__)
def test_other_models_of_the_arm(model: KinematicModel) -> None:
    rng = generator(8)
    q, L0 = 0.2 * normal((model.n,), torch.float64, rng), torch.tensor([0.2, 0.3], dtype=torch.float64)
    stack = TaskStack([Task("position", 0.3), Task("orientation")], damping=1e-2)
    rates = stack.rates(model, q, L0, [TaskTarget(q[:3]), TaskTarget(R_d=torch.eye(3).double())])
    want = jacobian(lambda q: stack.poses(model, q, L0)[0][0, :3, 3], q)
    torch.testing.assert_close(rates[0].J, want, rtol=0, atol=1e-12)
    cost = ClearanceCost([Sphere(torch.tensor([0.1, 0.0, 0.2]).double(), 0.1)], activation=0.2, self_separation=0.1)
    want = jacobian(lambda q: cost(model, q, L0)[0], q)
    torch.testing.assert_close(cost(model, q, L0)[1], want, rtol=0, atol=1e-10)


def test_refusals() -> None:
    with pytest.raises(ValueRangeError, match="at least one task"):
        TaskStack([])
    with pytest.raises(ValueRangeError, match="damping must be zero or positive"):
        TaskStack([Task()], damping=-1.0)
    with pytest.raises(ValueRangeError, match="coordinate_weights must be positive"):
        TaskStack([Task()], coordinate_weights=torch.zeros(9))
    q, L0 = arms(generator(6))
    stack = TaskStack([Task(), Task()])
    with pytest.raises(ShapeError, match="targets must hold one entry for each of 2 tasks, got 1"):
        stack.rates(BACKBONE, q, L0, [TaskTarget(q[:, :3])])
    rates = stack.rates(BACKBONE, q, L0, [TaskTarget(q[:, :3])] * 2)
    with pytest.raises(ShapeError, match="lower must have shape"):
        stack(rates, bounds=RateBounds(q[:, :3], q))
