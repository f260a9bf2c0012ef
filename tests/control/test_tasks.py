"""What tasks ask for, against finite differences of their own errors."""

from __future__ import annotations

import pytest
import torch
from hypothesis import given, settings
from torch import Tensor

from apcc_torch.control.task_stack import TaskStack
from apcc_torch.control.tasks import ROWS, Task, TaskRate, TaskTarget, shortest_turn
from apcc_torch.errors import ShapeError, ValueRangeError
from apcc_torch.lie import so3
from apcc_torch.model.backbone import PCCBackbone
from arms import HANGING_BASE, PI, configurations, rest_lengths
from laws import check_gradients, generator, normal, rotation_vectors, rotations, seeds, unit_vectors

BACKBONE = PCCBackbone(3, HANGING_BASE)


def arms(rng: torch.Generator, rows: int = 6) -> tuple[Tensor, Tensor]:
    """q (rows, 9) and rest lengths (rows, 3)."""
    return configurations((rows,), 3, torch.float64, rng), rest_lengths((rows,), 3, torch.float64, rng)


def target_near(task: Task, q: Tensor, L0: Tensor, rng: torch.Generator) -> TaskTarget:
    """A target that the arm at q misses by a little turn and shift."""
    T, _ = TaskStack([task]).poses(BACKBONE, q, L0)
    R = so3.exp(0.3 * rotation_vectors((len(q),), torch.float64, rng, 1.0)) @ T[:, 0, :3, :3]
    x_d = T[:, 0, :3, 3] + 0.05 * normal((len(q), 3), torch.float64, rng)
    return TaskTarget(x_d=x_d, R_d=R, direction=R[..., 2])


def rate_of(task: Task, q: Tensor, L0: Tensor, target: TaskTarget) -> TaskRate:
    return TaskStack([task]).rates(BACKBONE, q, L0, [target])[0]


@pytest.mark.parametrize("what", ROWS)
@pytest.mark.parametrize("abscissa", [None, 0.5])
def test_following_a_task_lowers_its_error_at_its_gain(what: str, abscissa: float | None) -> None:
    rng = generator(3)
    q, L0 = arms(rng)[0], PI.expand(6, 3)
    task = Task(what, abscissa, gain=1.7, angular_weight=1.0)
    target = target_near(task, q, L0, rng)
    rate = rate_of(task, q, L0, target)
    assert rate.J.shape == (6, ROWS[what], 9)
    qdot = TaskStack([task], damping=0.0)([rate])
    h = 1e-6
    before = rate_of(task, q - h * qdot, L0, target).error.norm(dim=-1)
    after = rate_of(task, q + h * qdot, L0, target).error.norm(dim=-1)
    torch.testing.assert_close((after - before) / (2 * h), -1.7 * rate.error.norm(dim=-1), rtol=1e-5, atol=1e-7)


@pytest.mark.parametrize("what", ["position", "orientation", "pose"])
def test_jacobians_against_finite_differences(what: str) -> None:
    rng = generator(4)
    q, L0 = arms(rng)
    task = Task(what, 0.2)
    rate = rate_of(task, q, L0, target_near(task, q, L0, rng))
    h = 1e-6
    stack = TaskStack([task])
    for i in range(9):
        step = h * torch.eye(9, dtype=torch.float64)[i]
        (high, _), (low, _) = stack.poses(BACKBONE, q + step, L0), stack.poses(BACKBONE, q - step, L0)
        turned = so3.log(high[:, 0, :3, :3] @ low[:, 0, :3, :3].mT) / (2 * h)
        moved = (high - low)[:, 0, :3, 3] / (2 * h)
        want = {"position": moved, "orientation": turned, "pose": torch.cat((turned, moved), dim=-1)}[what]
        torch.testing.assert_close(rate.J[..., i], want, rtol=1e-6, atol=1e-8)


def test_a_moving_target_is_followed_without_error() -> None:
    rng = generator(5)
    q, L0 = arms(rng)
    T, _ = TaskStack([Task()]).poses(BACKBONE, q, L0)
    omega, v = normal((6, 3), torch.float64, rng), normal((6, 3), torch.float64, rng)
    here = TaskTarget(T[:, 0, :3, 3], v, T[:, 0, :3, :3], omega, T[:, 0, :3, 2])
    torch.testing.assert_close(rate_of(Task("position"), q, L0, here).velocity, v)
    torch.testing.assert_close(rate_of(Task("orientation"), q, L0, here).velocity, omega)
    both = rate_of(Task("pose"), q, L0, here)
    torch.testing.assert_close(both.velocity, torch.cat((omega, v), dim=-1))
    # A turn about the direction itself does not move it: the other two components remain, in the point's axes.
    in_point = (T[:, 0, :3, :3].mT @ omega.unsqueeze(-1))[..., :2, 0]
    torch.testing.assert_close(rate_of(Task("direction"), q, L0, here).velocity, in_point)


def test_a_measured_pose_counts_and_not_the_models() -> None:
    rng = generator(6)
    q, L0 = arms(rng)
    task = Task("pose")
    target = target_near(task, q, L0, rng)
    assert target.R_d is not None and target.x_d is not None
    seen = torch.eye(4, dtype=torch.float64).repeat(6, 1, 1)
    seen[:, :3, :3], seen[:, :3, 3] = target.R_d, target.x_d
    reached = TaskStack([task]).rates(BACKBONE, q, L0, [target], [seen])[0]
    torch.testing.assert_close(reached.error, torch.zeros(6, 6, dtype=torch.float64), rtol=0, atol=1e-12)


@given(seed=seeds)
@settings(max_examples=30)
def test_the_shortest_turn_reaches_the_direction(seed: int) -> None:
    rng = generator(seed)
    R, d = rotations((4,), torch.float64, rng), unit_vectors((4,), torch.float64, rng)
    w = shortest_turn(R, d)
    torch.testing.assert_close((so3.exp(w) @ R)[..., 2], d, rtol=0, atol=1e-9)
    angle = torch.acos((R[..., 2] * d).sum(-1).clamp(-1, 1))
    torch.testing.assert_close(w.norm(dim=-1), angle, rtol=0, atol=1e-6)
    torch.testing.assert_close((w * R[..., 2]).sum(-1), torch.zeros(4, dtype=torch.float64), rtol=0, atol=1e-9)


def test_no_turn_and_half_a_turn() -> None:
    R = rotations((3,), torch.float64, generator(7))
    zero = torch.zeros(3, dtype=torch.float64)
    torch.testing.assert_close(shortest_turn(R, R[..., 2]).norm(dim=-1), zero, rtol=0, atol=1e-15)
    half = shortest_turn(R, -R[..., 2])
    torch.testing.assert_close((so3.exp(half) @ R)[..., 2], -R[..., 2], rtol=0, atol=1e-12)
    check_gradients(lambda d: shortest_turn(R[0], d), R[0, :, 2].clone(), second=False)


def test_rows_weigh_as_told() -> None:
    q, L0 = arms(generator(8), rows=2)
    target = TaskTarget(x_d=torch.zeros(3).double(), R_d=torch.eye(3).double())
    weight = torch.tensor([1.0, 4.0], dtype=torch.float64)
    rate = rate_of(Task("pose", weight=weight, angular_weight=0.2), q, L0, target)
    want = weight.unsqueeze(-1) * torch.tensor([0.2, 0.2, 0.2, 1.0, 1.0, 1.0], dtype=torch.float64)
    torch.testing.assert_close(rate.weight, want)


def test_refusals() -> None:
    with pytest.raises(ValueRangeError, match="what must be one of position"):
        Task("speed")
    with pytest.raises(ValueRangeError, match="weight must be positive"):
        Task(weight=0.0)
    with pytest.raises(ShapeError, match="gain must have shape"):
        Task("pose", gain=torch.ones(3).double())
    q, L0 = arms(generator(9))
    needs = {"position": "x_d", "orientation": "R_d", "direction": "direction", "pose": "R_d"}
    for what, name in needs.items():
        with pytest.raises(ValueRangeError, match=f"kind {what} needs {name}"):
            rate_of(Task(what), q, L0, TaskTarget())
