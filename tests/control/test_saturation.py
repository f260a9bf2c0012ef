"""Coordinates of q_d at their bounds: they drop out of the inverse kinematics, row by row, and the command says so."""

from __future__ import annotations

from typing import Any

import pytest
import torch
from torch import Tensor

from apcc_torch import APCCController, Arm
from apcc_torch.control.bounds import RateBounds, eased, solved_within
from apcc_torch.control.inverse_kinematics import InverseKinematics
from apcc_torch.control.step_io import Command, ControllerState, Measurement, Target
from apcc_torch.control.task_controller import TaskController
from apcc_torch.control.tendon_limits import SolverStatus, TendonLimits
from apcc_torch.estimation.savitzky_golay import SavitzkyGolay
from apcc_torch.estimation.state_feedback import StateFeedback
from apcc_torch.linalg import damped_pseudo_inverse
from apcc_torch.model.abscissae import decouple
from apcc_torch.model.backbone import PCCBackbone
from apcc_torch.model.tendons import rack_routing
from arms import HANGING_BASE, PI
from laws import generator, normal, uniform

D = torch.float64
ROWS, DT = 6, 0.05


def scene(c: APCCController) -> tuple[Tensor, Target]:
    """Configurations to start from, and targets that bends alone reach."""
    rng = generator(4)
    goal, away = (uniform((ROWS, 3, 3), -most, most, D, rng) for most in (0.6, 0.4))
    goal[..., 2] = away[..., 2] = 0.0
    return (goal + away).flatten(-2), Target(c.backbone.tip(goal.flatten(-2), PI), torch.zeros(3).double())


def follow(c: APCCController, steps: int) -> tuple[ControllerState, list[Command]]:
    """A run on an arm that does what it is told."""
    q, target = scene(c)
    state, commands = c.initial_state(q, PI.expand(ROWS, 3)), []
    with torch.no_grad():
        for k in range(steps):
            T = c.backbone.pose(state.q_d, PI, *decouple(c.feedback.abscissae, PI))
            state, command = c(state, Measurement(T, torch.tensor((k + 1) * DT).double()), target)
            commands.append(command)
    return state, commands


def fixed(**settings: Any) -> APCCController:
    return APCCController.for_arm(Arm(lengths=PI.tolist()), adaptation=None, K=5.0, **settings)


@pytest.mark.parametrize("bound", [4e-3, 1e-6])
def test_a_nearly_inextensible_arm_reaches_its_targets(bound: float) -> None:
    state, commands = follow(fixed(elongation_bound=bound), 40)
    assert float(commands[-1].e.norm(dim=-1).max()) < 2e-4
    assert float(state.q_d[..., 2::3].abs().max()) <= bound
    statuses = torch.stack([c.limits for c in commands if c.limits is not None])
    assert statuses.shape == (40, ROWS)
    assert set(statuses.flatten().tolist()) == {int(SolverStatus.FREE), int(SolverStatus.LIMITED)}


def test_a_row_within_its_bounds_stays_as_it_is() -> None:
    # One row is bounded tightly, the others not at all; theirs is the run without bounds, bit for bit.
    bound = torch.full((ROWS,), 1.0, dtype=D)
    bound[2] = 2e-3
    state, commands = follow(fixed(elongation_bound=bound), 10)
    want, free = follow(fixed(), 10)
    others = torch.arange(ROWS) != 2
    assert torch.equal(state.q_d[others], want.q_d[others]) and not torch.equal(state.q_d[2], want.q_d[2])
    limits = commands[-1].limits
    assert not free[-1].limits.any() and limits is not None
    assert (limits[others] == SolverStatus.FREE).all()


def test_what_is_held_is_the_best_of_what_is_free() -> None:
    # Held coordinates have no rate, and the free ones solve Eq. (16) of an arm without the held ones.
    rng = generator(5)
    J, v, q = normal((40, 3, 9), D, rng), normal((40, 3), D, rng), 0.02 * normal((40, 9), D, rng)
    solver, infinite = InverseKinematics(1.0, null_gain=0.1), torch.full((40, 9), torch.inf, dtype=D)
    upper = torch.where(uniform((40, 9), 0.0, 1.0, D, rng) < 0.4, 0.0, infinite)
    qdot = solver(J, torch.zeros_like(v), v, q, bounds=RateBounds(-infinite, upper))
    assert (qdot <= upper).all() and float((qdot - solver(J, torch.zeros_like(v), v, q)).abs().max()) > 0.1
    met = (J @ qdot.unsqueeze(-1)).squeeze(-1)
    free = ((qdot != 0.0).sum(-1) >= 4).nonzero().squeeze(-1)
    assert len(free) > 20
    torch.testing.assert_close(met[free], v[free], rtol=0, atol=1e-3)


def test_a_row_that_is_not_finite_harms_no_other() -> None:
    one = torch.ones(3, 2, dtype=D)
    one[1] = torch.nan

    def solve(rates: Tensor | None, free: Tensor | None) -> Tensor:
        return one if free is None else one * (2.0 - free.amin(-1, keepdim=True))

    upper = torch.tensor([torch.inf, 0.5], dtype=D)
    solved = solved_within(solve, RateBounds(-upper, upper))
    assert solved[0].tolist() == solved[2].tolist() == [2.0, 0.5] and solved[1].isnan().all()


def task_controller(**more: Any) -> TaskController:
    backbone = PCCBackbone(3, HANGING_BASE)
    parts = (backbone, StateFeedback(backbone, PI.cumsum(0)), SavitzkyGolay(5, 2), InverseKinematics(5.0))
    return TaskController(*parts, elongation_bound=1e-3, routing=rack_routing(PI.cumsum(0)), **more)


@pytest.mark.parametrize("wide", [False, True])
def test_a_stack_of_tasks_holds_its_bounds_too(wide: bool) -> None:
    if wide:
        pytest.importorskip("daqp")
    bound = torch.full((9,), 5.0, dtype=D)
    c = task_controller(tendon_limits=TendonLimits(-bound, bound) if wide else None)
    state, commands = follow(c, 40)
    assert float(commands[-1].e.norm(dim=-1).max()) < 2e-4
    assert float(state.q_d[..., 2::3].abs().max()) <= 1e-3
    assert any((c.limits == SolverStatus.LIMITED).any() for c in commands if c.limits is not None)


@pytest.mark.parametrize("shape", [(3, 9), (3, 3), (6, 4)])
def test_a_task_asks_for_no_faster_rates_than_it_may_and_comes_to_rest_as_without(shape: tuple[int, int]) -> None:
    """Against the least squares that it stands for, |J qdot - v|^2 + damping^2 |qdot|^2, by another solver."""
    rng = generator(6)
    J, v = normal((60, *shape), D, rng), normal((60, shape[0], 1), D, rng)
    J[::2, 1] = J[::2, 0] * (1.0 + 1e-6)  # next to singular, so nearly any rate would be asked for
    infinite, together = torch.full((60, shape[1]), torch.inf, dtype=D), uniform((60,), 0.1, 2.0, D, rng)
    bounds = RateBounds(-infinite, infinite, together)
    damping = eased(1e-3, v, bounds)
    qdot = damped_pseudo_inverse(J, damping) @ v
    assert (qdot.norm(dim=(-2, -1)) <= together * (1.0 + 1e-9)).all()
    wide = torch.cat((J, damping * torch.eye(shape[1], dtype=D)), dim=-2)
    least = torch.linalg.lstsq(wide, torch.nn.functional.pad(v, (0, 0, 0, shape[1])), driver="gelsd").solution
    torch.testing.assert_close(qdot, least, rtol=1e-7, atol=1e-9)
    slow = eased(1e-3, 1e-6 * v, bounds)
    assert torch.equal(torch.as_tensor(slow), torch.full((60, 1, 1), 1e-3, dtype=D))
    assert eased(1e-3, v, None) == 1e-3 and eased(1e-3, v, RateBounds(-infinite, infinite)) == 1e-3
