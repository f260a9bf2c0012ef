"""Goals, errors and rewards, each computed a second way."""

from __future__ import annotations

import pytest
import torch

from apcc_torch.envs.streams import streams
from apcc_torch.envs.tasks import Reach, Shape, Track
from apcc_torch.model.abscissae import decouple
from apcc_torch.model.arm import Arm
from apcc_torch.model.backbone import PCCBackbone
from apcc_torch.simulation.metrics import shape_error
from arm_rows import IDS, actions, make

ARM = Arm.load("arm_1")
LIKE = torch.empty(0, dtype=torch.float64)
LENGTHS = ARM.rest_lengths().expand(8, 3)


def test_the_tracked_point_moves_at_its_velocity() -> None:
    task = Track(ARM, LIKE)
    _, goal = task.draw(streams(0, 8, torch.device("cpu")), LENGTHS)
    time = torch.linspace(0.0, 3.0, 8, dtype=torch.float64).requires_grad_()
    x_d, xdot_d, _ = task.target(goal, time)
    for axis in range(3):
        (rate,) = torch.autograd.grad(x_d[:, axis].sum(), time, retain_graph=True)
        torch.testing.assert_close(rate, xdot_d[:, axis])


@pytest.mark.parametrize("kind", [Reach, Track, Shape])
def test_goals_are_within_reach(kind: type[Reach]) -> None:
    """Some configuration of the row's own arm has the goal's points: its sections have their lengths, to 20 mm."""
    task = kind(ARM, LIKE)
    _, goal = task.draw(streams(3, 8, torch.device("cpu")), LENGTHS)
    ends = torch.nn.functional.pad(goal.points.sensors, (0, 0, 1, 0))
    chords = ends.diff(dim=1).norm(dim=-1)
    assert bool((chords <= LENGTHS + 0.02 + 1e-9).all()) and bool((chords >= 0.9 * (LENGTHS - 0.02)).all())


@pytest.mark.parametrize("name", IDS)
def test_reward_is_what_the_documentation_says(name: str) -> None:
    envs = make(name, 8)
    envs.reset(seed=1)
    action = actions(envs, 5)
    _, reward, _, _, info = envs.step(action)
    state = envs.state
    assert state is not None
    points = PCCBackbone(3, ARM.base_rotation()).points(state.q_d, LENGTHS, 61, "material")
    if name == "apcc/Shape-v0":
        ends, middles = LENGTHS.cumsum(-1), LENGTHS.cumsum(-1) - 0.5 * LENGTHS
        X = torch.stack((middles, ends), dim=-1).flatten(1)
        at = points.gather(1, (X / 0.6 * 60).round().long().unsqueeze(-1).expand(-1, -1, 3))
        error, scale = shape_error(state.goal.points.backbone, at), 0.05
    elif name == "apcc/Track-v0":
        g = state.goal
        assert g.amplitude is not None and g.omega is not None and g.phase is not None
        x_d = g.points.backbone[:, -1] + g.amplitude * torch.sin(g.omega.unsqueeze(-1) * 0.01 + g.phase)
        error, scale = (x_d - points[:, -1]).norm(dim=-1), 0.1
    else:
        error, scale = (state.goal.points.backbone[:, -1] - points[:, -1]).norm(dim=-1), 0.1
    loose = 5e-3 if name == "apcc/Shape-v0" else 1e-6  # 61 points do not fall on every section's middle
    torch.testing.assert_close(info["error"].double(), error, rtol=0.0, atol=loose)
    want = (error < 0.01).double() - error / scale - 0.01 * action.double().square().mean(-1)
    torch.testing.assert_close(reward.double(), want, rtol=0.0, atol=loose / scale + 1e-5)


def test_success_pays_one() -> None:
    envs = make("apcc/Reach-v0", 3)
    envs.reset(seed=0)
    assert envs.state is not None
    points = envs.simulator.arm.points(envs.state.arm, envs.state.rows)
    envs.state = envs.state._replace(goal=envs.state.goal._replace(points=points))
    _, reward, _, _, info = envs.step(torch.zeros(3, 9))
    assert reward.tolist() == [1.0] * 3 and bool(info["is_success"].all())


def test_adaptation_pays_for_the_models_error() -> None:
    envs = make("apcc/Reach-v0", 4, action="adaptation")
    envs.reset(seed=0)
    _, reward, _, _, info = envs.step(torch.zeros(4, 3))
    state = envs.state
    assert state is not None and state.controller is not None
    backbone, half = PCCBackbone(3, ARM.base_rotation()), torch.tensor([0.5, 1.0] * 3, dtype=torch.float64)
    j = torch.tensor([0, 0, 1, 1, 2, 2])
    true = backbone.pose(state.arm.q, LENGTHS[:4], half, j)[..., :3, 3]
    X = torch.stack((LENGTHS[0].cumsum(0) - 0.5 * LENGTHS[0], LENGTHS[0].cumsum(0)), dim=-1).flatten()
    pi_hat = state.controller.pi_hat
    model = backbone.pose(state.controller.q_bar, pi_hat, *decouple(X, pi_hat))[..., :3, 3]
    want = -info["error"].double() / 0.1 - shape_error(true, model) / 0.05
    torch.testing.assert_close(reward.double(), want, rtol=1e-5, atol=1e-6)
