"""What actions do to the desired configuration, and so to the arm."""

from __future__ import annotations

import pytest
import torch

from apcc_torch.envs.actions import ActionSettings, Drive
from apcc_torch.errors import ConfigError
from apcc_torch.model.arm import Arm
from arm_rows import actions, make
from arms import configurations
from laws import generator, uniform

ARM, LIMITS = Arm.load("arm_1"), ActionSettings()
LIKE = torch.empty(0, dtype=torch.float64)


def drive(mode: str) -> Drive:
    return Drive(ARM, 0.01, LIKE, action=mode)


def test_configuration_velocity() -> None:
    q = torch.zeros(1, 9, dtype=torch.float64)
    moved = drive("configuration_velocity")(q, torch.tensor([[1.0, -1.0, 0.5] * 3], dtype=torch.float64))
    assert moved.tolist()[0] == pytest.approx([0.03, -0.03, 0.0005] * 3)


def test_task_velocity_moves_the_tip_that_way() -> None:
    q = configurations((20,), 3, torch.float64, generator(0), bend=0.6)
    action = uniform((20, 3), -0.3, 0.3, torch.float64, generator(1))
    task = drive("task_velocity")
    velocity = (task.backbone.tip(task(q, action), task.lengths) - task.backbone.tip(q, task.lengths)) / 0.01
    assert float((velocity - LIMITS.speed * action).norm(dim=-1).max()) < 0.02


def test_tendon_lengths_are_reached_and_no_rate_is_exceeded() -> None:
    tendons = drive("tendon_lengths")
    wanted = uniform((4, 9), -0.01, 0.01, torch.float64, generator(0))
    q = torch.zeros(4, 9, dtype=torch.float64)
    for _ in range(200):
        later = tendons(q, wanted / LIMITS.tendon_range)
        assert bool(((later - q).abs() <= 0.01 * tendons.rates + 1e-15).all())
        q = later
    torch.testing.assert_close(ARM.routing().lengths(q, ARM.rest_lengths()), wanted, rtol=1e-9, atol=1e-12)


@pytest.mark.parametrize("mode", ["configuration_velocity", "task_velocity", "tendon_lengths"])
def test_bounds_hold(mode: str) -> None:
    moves = drive(mode)
    q = torch.zeros(3, 9, dtype=torch.float64)
    action = uniform((3, 3 if mode == "task_velocity" else 9), -1.0, 1.0, torch.float64, generator(3)).sign()
    for _ in range(300):
        q = moves(q, action)
    assert bool((q.abs() <= moves.bounds).all())


def test_adaptation_gains_decide_how_fast_the_model_learns() -> None:
    """Over the first steps, before any bound, pi_hat moves in proportion to its gain."""
    moves = []
    for decade in (-1.0, 0.0):
        envs = make("apcc/Reach-v0", 4, action="adaptation", estimate=(1.05, 1.15))
        envs.reset(seed=0)
        assert envs.state is not None and envs.state.controller is not None
        first = envs.state.controller.pi_hat
        for _ in range(2):
            envs.step(torch.full((4, 3), decade))
        moves.append(envs.state.controller.pi_hat - first)
    torch.testing.assert_close(moves[1], 10.0 * moves[0], rtol=0.05, atol=1e-8)
    assert float(moves[1].abs().amax(-1).min()) > 1e-5


def test_the_controller_brings_the_tip_to_its_target() -> None:
    envs = make("apcc/Reach-v0", 4, action="adaptation", max_episode_steps=None)
    envs.reset(seed=0)
    for _ in range(500):
        _, _, _, _, info = envs.step(torch.zeros(4, 3))
    assert float(info["error"].max()) < 5e-3


@pytest.mark.parametrize("dynamics", ["kinematic", "dynamic"])
def test_adaptation_knows_where_each_rows_sensors_are(dynamics: str) -> None:
    """Nine coordinates determine the model's nine: whatever its lengths, it passes through the last step's sensors."""
    envs = make("apcc/Reach-v0", 4, action="adaptation", lengths=(0.9, 1.1), dynamics=dynamics)
    observation, _ = envs.reset(seed=0)
    for _ in range(100):
        before, (observation, *_) = observation, envs.step(torch.full((4, 3), -1.0))
    moved = (observation[:, :9] - before[:, :9]).unflatten(-1, (3, 3)).norm(dim=-1)
    assert bool((observation[:, -3:] < moved + 3e-3).all())


def test_unknown_action() -> None:
    with pytest.raises(ConfigError, match=r"action must be one of .*, got 'torque'"):
        make(action="torque")


def test_actions_outside_are_clipped() -> None:
    one, other = make(), make()
    for envs, scale in ((one, 1.0), (other, 50.0)):
        envs.reset(seed=0)
        envs.step(actions(envs).sign() * scale)
    assert one.state is not None and other.state is not None
    assert torch.equal(one.state.q_d, other.state.q_d)
