"""One arm: what Gymnasium and Stable-Baselines3 ask of an environment, and that it is row 0 of a batch."""

from __future__ import annotations

import importlib.util
import warnings

import gymnasium
import numpy as np
import pytest
import torch
from gymnasium.utils.env_checker import check_env

from apcc_torch.envs import TruncatedReason
from apcc_torch.errors import ConfigError
from arm_rows import IDS, make

MODES = ("configuration_velocity", "task_velocity", "tendon_lengths", "adaptation")
each = pytest.mark.parametrize(
    ("name", "action", "dynamics"),
    [(name, action, "kinematic") for name in IDS for action in MODES]
    + [("apcc/Reach-v0", action, "dynamic") for action in MODES],
)


@each
def test_gymnasiums_checker_is_content(name: str, action: str, dynamics: str) -> None:
    env = gymnasium.make(name, action=action, dynamics=dynamics).unwrapped
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        check_env(env, skip_render_check=True)


@each
def test_stable_baselines_checker_is_content(name: str, action: str, dynamics: str) -> None:
    if importlib.util.find_spec("stable_baselines3") is None:
        pytest.skip("stable-baselines3 is not installed")
    from stable_baselines3.common.env_checker import check_env as check

    with warnings.catch_warnings():
        warnings.simplefilter("error")
        check(gymnasium.make(name, action=action, dynamics=dynamics), warn=True)


def test_it_is_row_0_of_the_batch() -> None:
    env, envs = gymnasium.make("apcc/Track-v0", noise=(0.0, 1e-3)), make("apcc/Track-v0", 4, noise=(0.0, 1e-3))
    observation, _ = env.reset(seed=3)
    rows, _ = envs.reset(seed=3)
    np.testing.assert_allclose(observation, rows[0].numpy(), atol=1e-6)
    for _ in range(5):
        action = np.full(9, 0.4, dtype=np.float32)
        observation, reward, *_, info = env.step(action)
        rows, rewards, *_ = envs.step(torch.as_tensor(action).expand(4, 9))
        np.testing.assert_allclose(observation, rows[0].numpy(), atol=1e-5)
        assert reward == pytest.approx(float(rewards[0]), abs=1e-5) and isinstance(info["is_success"], bool)


def test_the_time_limit_is_gymnasiums() -> None:
    env = gymnasium.make("apcc/Reach-v0", max_episode_steps=3)
    env.reset(seed=0)
    steps = [env.step(np.zeros(9, dtype=np.float32)) for _ in range(3)]
    assert [step[3] for step in steps] == [False, False, True]
    reasons = [step[4]["truncated_reason"] for step in steps]
    assert reasons == [TruncatedReason.NONE, TruncatedReason.NONE, TruncatedReason.TIME_LIMIT]


def test_a_reason_of_its_own_goes_before_the_time_limit_and_a_new_wrapper_has_a_new_one() -> None:
    env = gymnasium.make("apcc/Reach-v0", max_episode_steps=1)
    env.reset(seed=0)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of Gymnasium, on the action
        info = env.step(np.full(9, np.nan, dtype=np.float32))[4]
    assert info["truncated_reason"] == TruncatedReason.NOT_FINITE
    longer = gymnasium.wrappers.TimeLimit(env.unwrapped, 2)
    longer.reset(seed=0)
    reasons = [longer.step(np.zeros(9, dtype=np.float32))[4]["truncated_reason"] for _ in range(2)]
    assert reasons == [TruncatedReason.NONE, TruncatedReason.TIME_LIMIT]


def test_the_module_may_be_named_in_the_id() -> None:
    assert gymnasium.make_vec("apcc_torch.envs:apcc/Shape-v0", num_envs=2).num_envs == 2


def test_unknown_render_mode() -> None:
    with pytest.raises(ConfigError, match="render_mode must be one of human, rgb_array, got 'ansi'"):
        gymnasium.make("apcc/Reach-v0", render_mode="ansi")
