"""The controller with further tasks, clearance and tendon limits, in the closed loop of section V-A."""

from __future__ import annotations

from typing import Any

import pytest
import torch
from torch import Tensor

from apcc_torch.control.adaptation import AdaptiveLaw
from apcc_torch.control.clearance import ClearanceCost
from apcc_torch.control.controller import APCCController
from apcc_torch.control.inverse_kinematics import InverseKinematics
from apcc_torch.control.length_bounds import LengthBounds
from apcc_torch.control.obstacles import Sphere
from apcc_torch.control.step_io import Command, ControllerState, Measurement, Target
from apcc_torch.control.task_controller import TaskController
from apcc_torch.control.tasks import Task, TaskTarget
from apcc_torch.control.tendon_limits import SolverStatus, TendonLimits
from apcc_torch.errors import ConfigError, ShapeError
from apcc_torch.estimation.savitzky_golay import SavitzkyGolay
from apcc_torch.estimation.state_feedback import StateFeedback
from apcc_torch.lie import so3
from apcc_torch.model.abscissae import decouple
from apcc_torch.model.affine import AffineBackbone
from apcc_torch.model.backbone import PCCBackbone
from apcc_torch.model.tendons import rack_routing
from arms import HANGING_BASE, PI, PI_HAT

BACKBONE = PCCBackbone(3, HANGING_BASE)
SENSORS = torch.tensor([0.105, 0.36, 0.60], dtype=torch.float64)
ROUTING = rack_routing(SENSORS)
PLACES = decouple(SENSORS, PI)
DT = 0.04


def parts(K: float = 2.0, null_speed: float | None = None) -> dict[str, Any]:
    return {
        "backbone": BACKBONE,
        "feedback": StateFeedback(BACKBONE, SENSORS),
        "velocity_filter": SavitzkyGolay(window=9, order=2),
        "inverse_kinematics": InverseKinematics(
            K=K, null_gain=0.2, bend_rate=3.0, length_rate=0.3, null_speed=null_speed
        ),
        "laws": AdaptiveLaw(3, torch.tensor([9.0, 4.25, 3.5], dtype=torch.float64), normalisation=10.0),
        "bounds": LengthBounds(PI, SENSORS, lower=None, upper=None, reach="last"),
        "routing": ROUTING,
    }


def start() -> Tensor:
    return torch.tensor([0.3, 0.1, 0.0, 0.2, -0.1, 0.0, -0.2, 0.1, 0.0], dtype=torch.float64)


def seen(q: Tensor, step: int, mask: Tensor | None = None) -> Measurement:
    return Measurement(BACKBONE.pose(q, PI, *PLACES), torch.tensor(step * DT, dtype=torch.float64), mask)


def follow(
    controller: APCCController, target: Target, steps: int, pi_hat: Tensor = PI
) -> tuple[Tensor, list[Command], ControllerState]:
    """The true arm's last q, all commands, and the last state."""
    q = start()
    state, commands = controller.initial_state(q, pi_hat), []
    with torch.inference_mode():
        for k in range(steps):
            state, command = controller(state, seen(q, k + 1), target)
            q = q + DT * command.qdot
            commands.append(command)
    return q, commands, state


@pytest.mark.parametrize("null_speed", [None, 0.05])
def test_without_more_tasks_it_is_the_controller(null_speed: float | None) -> None:
    target = Target(torch.tensor([0.1, 0.05, -0.5]).double(), torch.tensor([0.02, 0.0, 0.01]).double())
    plain, more = (kind(**parts(null_speed=null_speed)) for kind in (APCCController, TaskController))
    _, one, _ = follow(plain, target, 12, PI_HAT)
    _, other, _ = follow(more, target, 12, PI_HAT)
    for a, b in zip(one, other, strict=True):
        torch.testing.assert_close(b.qdot, a.qdot, rtol=1e-9, atol=1e-11)
        torch.testing.assert_close(b.y, a.y, rtol=1e-9, atol=1e-11)
        assert int(b.limits) == int(a.limits) == SolverStatus.FREE


def test_position_and_orientation_are_reached_while_the_law_learns_from_position_alone() -> None:
    controller = TaskController(**parts(), tasks=[Task("orientation", gain=2.0)])
    R_d = so3.exp(torch.tensor([0.2, -0.1, 0.15], dtype=torch.float64)) @ HANGING_BASE
    x_d = torch.tensor([0.08, 0.05, -0.54], dtype=torch.float64)
    target = Target(x_d, torch.zeros(3).double(), (TaskTarget(R_d=R_d),))
    q, _, _ = follow(controller, target, 180, PI_HAT)
    T = BACKBONE.pose(q, PI, *PLACES)[-1]
    assert float((T[:3, 3] - x_d).norm()) < 1e-3
    assert float(so3.log(R_d @ T[:3, :3].mT).norm()) < 1e-2
    # One step from the same state: another wanted orientation moves the arm, and not the law.
    state = controller.initial_state(start(), PI_HAT)
    other = target._replace(tasks=(TaskTarget(R_d=HANGING_BASE),))
    (a, first), (b, second) = (controller(state, seen(start(), 1), t) for t in (target, other))
    assert float((first.qdot - second.qdot).abs().max()) > 1e-3
    assert torch.equal(first.e, second.e) and torch.equal(first.feedback.q_bar, second.feedback.q_bar)
    Y = controller.regressor(first.feedback.q_bar, a.qdot_bar, PI_HAT)
    (law,) = controller.laws
    assert isinstance(law, AdaptiveLaw) and controller.bounds is not None
    want = controller.bounds(law(PI_HAT, Y, first.e, torch.tensor(DT, dtype=torch.float64)), law.metric)
    torch.testing.assert_close(a.pi_hat, want)
    torch.testing.assert_close(b.pi_hat, want)


def test_a_material_point_below_the_tip_in_priority() -> None:
    middle = torch.tensor([0.06, 0.0, -0.34], dtype=torch.float64)
    x_d = torch.tensor([0.05, 0.05, -0.55], dtype=torch.float64)
    controller = TaskController(**parts(), tasks=[Task("position", 0.36, gain=2.0, level=1)])
    assert controller.sensors == [1]
    q, _, _ = follow(controller, Target(x_d, torch.zeros(3).double(), (TaskTarget(middle),)), 180)
    T = BACKBONE.pose(q, PI, *PLACES)
    assert float((T[2, :3, 3] - x_d).norm()) < 1e-3 and float((T[1, :3, 3] - middle).norm()) < 1e-3
    # A wish that contradicts the tip's goal costs the tip nothing.
    far = Target(x_d, torch.zeros(3).double(), (TaskTarget(torch.tensor([0.15, 0.15, -0.3]).double()),))
    q, _, _ = follow(controller, far, 180)
    assert float((BACKBONE.tip(q, PI) - x_d).norm()) < 2e-3


def test_a_sensor_that_does_not_count_is_replaced_by_the_model() -> None:
    controller = TaskController(**parts(), tasks=[Task("orientation"), Task("direction", 0.2)])
    assert controller.sensors == [2, None]
    target = TaskTarget(R_d=HANGING_BASE, direction=torch.tensor([0.0, 0.0, -1.0]).double())
    whole = Target(torch.tensor([0.1, 0.0, -0.5]).double(), torch.zeros(3).double(), (target, target))
    good = seen(start(), 1)
    bad = good.T.clone()
    bad[2] = torch.nan
    blind = good._replace(T=bad, mask=torch.tensor([True, True, False]))
    _, command = controller(controller.initial_state(start(), PI), blind, whole)
    assert bool(torch.isfinite(command.qdot).all())
    # The model is right here, so what it says is what the sensor would have said.
    _, usual = controller(controller.initial_state(start(), PI), good, whole)
    torch.testing.assert_close(command.qdot, usual.qdot, rtol=1e-3, atol=1e-4)


def test_clearance_bends_the_arm_away() -> None:
    x_d = torch.tensor([0.25, 0.0, -0.47], dtype=torch.float64)
    target = Target(x_d, torch.zeros(3).double())
    cost = ClearanceCost([Sphere(torch.tensor([0.14, 0.02, -0.28]).double(), 0.05)], 0.02, 0.04, 30)
    ends = {
        name: follow(TaskController(**parts(), clearance=c), target, 180)[0]
        for name, c in (("no", None), ("yes", cost))
    }
    gaps = {name: float(cost.clearance(BACKBONE, q, PI).obstacles) for name, q in ends.items()}
    assert gaps["no"] < 0.0 < gaps["yes"]
    for q in ends.values():
        assert float((BACKBONE.tip(q, PI) - x_d).norm()) < 1e-3


def test_what_the_tendons_do_not_move_is_not_commanded() -> None:
    arm = AffineBackbone(3, HANGING_BASE)
    cost = ClearanceCost([Sphere(torch.tensor([0.1, 0.0, -0.3]).double(), 0.05)], 0.02, 0.2)
    controller = TaskController(
        arm,
        StateFeedback(arm, SENSORS),
        SavitzkyGolay(window=9, order=2),
        InverseKinematics(null_gain=0.05, coordinates=arm.coordinates),
        AdaptiveLaw(3, 1.0),
        tasks=[Task("orientation")],
        clearance=cost,
    )
    target = Target(torch.tensor([0.1, 0.0, -0.5]).double(), torch.zeros(3).double(), (TaskTarget(R_d=HANGING_BASE),))
    state = controller.initial_state(torch.zeros(arm.n).double(), PI)
    _, command = controller(state, seen(start(), 1), target)
    slopes = arm.coordinates.of_pattern(command.qdot)[..., 2:4]
    assert float(slopes.abs().max()) == 0.0
    assert float(command.qdot.abs().max()) > 0.0


def limited(limit: float, rate: float | None = None, **more: bool) -> TaskController:
    bound = torch.full((9,), limit, dtype=torch.float64)
    limits = TendonLimits(-bound, bound, None if rate is None else torch.full((9,), rate, dtype=torch.float64))
    return TaskController(**parts(), tendon_limits=limits, **more)


@pytest.mark.parametrize("adaptive", [False, True])
def test_commands_never_leave_the_tendons_limits(adaptive: bool) -> None:
    pytest.importorskip("daqp")
    target = Target(torch.tensor([0.3, 0.2, -0.35]).double(), torch.zeros(3).double())
    free = follow(APCCController(**parts(), adaptive=adaptive), target, 100, PI_HAT)[1]
    assert max(float(c.y.abs().max()) for c in free if c.y is not None) > 0.03
    _, commands, _ = follow(limited(0.02, 0.05, adaptive=adaptive), target, 100, PI_HAT)
    ys = torch.stack([c.y for c in commands if c.y is not None])
    assert float(ys.abs().max()) <= 0.02 + 1e-12
    if not adaptive:
        assert float((ys[1:] - ys[:-1]).abs().max()) <= 0.05 * DT + 1e-9
    statuses = {int(c.limits) for c in commands if c.limits is not None}
    assert SolverStatus.LIMITED in statuses and SolverStatus.NOT_FINITE not in statuses


def test_wide_limits_change_nothing() -> None:
    pytest.importorskip("daqp")
    target = Target(torch.tensor([0.1, 0.05, -0.5]).double(), torch.zeros(3).double())
    _, one, _ = follow(APCCController(**parts(), adaptive=False), target, 10)
    _, other, _ = follow(limited(5.0, adaptive=False), target, 10)
    for a, b in zip(one, other, strict=True):
        torch.testing.assert_close(b.qdot, a.qdot, rtol=0, atol=1e-7)
        assert int(b.limits) == SolverStatus.FREE


def test_leading_dimensions_are_a_batch() -> None:
    cost = ClearanceCost([Sphere(torch.tensor([0.14, 0.02, -0.28]).double(), 0.05)], 0.02, 0.3)
    controller = TaskController(**parts(), tasks=[Task("direction", level=1)], clearance=cost)
    q = torch.stack((start(), -start(), 0.5 * start()))
    down = torch.tensor([0.0, 0.0, -1.0], dtype=torch.float64)
    target = Target(torch.tensor([0.1, 0.0, -0.5]).double(), down * 0.1, (TaskTarget(direction=down),))
    together, _ = controller(controller.initial_state(q, PI), seen(q, 1), target)
    for i in range(3):
        alone, _ = controller(controller.initial_state(q[i], PI), seen(q[i], 1), target)
        torch.testing.assert_close(together.q_d[i], alone.q_d)
        torch.testing.assert_close(together.pi_hat[i], alone.pi_hat)


def test_refusals() -> None:
    bound = torch.ones(9, dtype=torch.float64)
    limits = TendonLimits(-bound, bound)
    with pytest.raises(ConfigError, match="tendon_limits needs a routing"):
        TaskController(**{**parts(), "routing": None}, tendon_limits=limits)
    with pytest.raises(ConfigError, match="needs all tasks at level 0"):
        TaskController(**parts(), tasks=[Task(level=1)], tendon_limits=limits)
    controller = TaskController(**parts(), tasks=[Task("orientation")])
    target = Target(torch.zeros(3).double(), torch.zeros(3).double())
    with pytest.raises(ShapeError, match="targets must hold one entry for each of 2 tasks, got 1"):
        controller(controller.initial_state(start(), PI), seen(start(), 1), target)
