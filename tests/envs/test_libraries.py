"""Other people's wrappers and learners on the batch; those that are not installed are skipped."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from gymnasium.wrappers.vector import RecordEpisodeStatistics

from apcc_torch.errors import ConfigError
from arm_rows import actions, make
from laws import generator


@pytest.mark.parametrize("mode", ["NEXT_STEP", "SAME_STEP"])
def test_record_episode_statistics(mode: str) -> None:
    conversion = pytest.importorskip("gymnasium.wrappers.vector.array_conversion", exc_type=ImportError)
    batch = make(num_envs=4, max_episode_steps=5, autoreset_mode=mode)
    envs = RecordEpisodeStatistics(conversion.ArrayConversion(batch, env_xp=torch, target_xp=np))
    envs.reset(seed=0)
    total = np.zeros(4)
    for _ in range(5):
        _, reward, _, truncated, info = envs.step(np.full((4, 9), 0.1, dtype=np.float32))
        total += reward
    assert isinstance(reward, np.ndarray) and truncated.all()
    np.testing.assert_allclose(info["episode"]["r"], total, rtol=1e-6)
    assert info["episode"]["l"].tolist() == [5] * 4
    envs.reset(options={"reset_mask": np.array([True, False, False, False])})


@pytest.mark.parametrize("dynamics", ["kinematic", "dynamic"])
def test_stable_baselines_steps_the_batch(dynamics: str) -> None:
    pytest.importorskip("stable_baselines3")
    from apcc_torch.envs.sb3 import ArmVecEnv

    settings = {"num_envs": 3, "max_episode_steps": 4, "autoreset_mode": "SAME_STEP", "dynamics": dynamics}
    adapter, plain = ArmVecEnv(make(**settings)), make(**settings)
    adapter.seed(0)
    np.testing.assert_array_equal(adapter.reset(), plain.reset(seed=0)[0].numpy())
    for k in range(4):
        action = actions(plain, k)
        seen, reward, done, infos = adapter.step(action.numpy())
        want, want_reward, _, truncated, info = plain.step(action)
        np.testing.assert_array_equal(seen, want.numpy())
        np.testing.assert_array_equal(reward, want_reward.numpy())
        np.testing.assert_array_equal(done, truncated.numpy())
    assert done.all() and len({id(row) for row in infos}) == 3
    for i, row in enumerate(infos):
        np.testing.assert_array_equal(row["terminal_observation"], info["final_obs"][i].numpy())
        assert row["TimeLimit.truncated"] is True and row["is_success"] is False


def test_stable_baselines_learns_on_it() -> None:
    ppo = pytest.importorskip("stable_baselines3").PPO
    from stable_baselines3.common.vec_env import VecMonitor

    from apcc_torch.envs.sb3 import ArmVecEnv

    envs = VecMonitor(ArmVecEnv(make(num_envs=4, max_episode_steps=8, autoreset_mode="SAME_STEP")))
    model = ppo("MlpPolicy", envs, n_steps=16, batch_size=32, n_epochs=1, seed=0, device="cpu")
    before = [p.clone() for p in model.policy.parameters()]
    model.learn(64)
    assert any(not torch.equal(a, b) for a, b in zip(before, model.policy.parameters(), strict=True))
    assert len(model.ep_info_buffer) == 8 and {info["l"] for info in model.ep_info_buffer} == {8}


def test_stable_baselines_wants_a_reset_in_the_same_step() -> None:
    pytest.importorskip("stable_baselines3")
    from apcc_torch.envs.sb3 import ArmVecEnv

    with pytest.raises(ConfigError, match='autoreset_mode="SAME_STEP", got NEXT_STEP'):
        ArmVecEnv(make())


def test_torchrl_steps_the_batch() -> None:
    library = pytest.importorskip("torchrl.envs")
    envs = library.GymWrapper(make(num_envs=3, max_episode_steps=4, autoreset_mode="SAME_STEP"), device="cpu")
    envs.set_seed(0)
    rollout = envs.rollout(6, break_when_any_done=False)
    assert rollout.batch_size == (3, 6) and rollout["observation"].shape == (3, 6, 42)
    assert rollout["next", "truncated"][..., 0].tolist() == [[k == 3 for k in range(6)]] * 3
    assert bool(torch.isfinite(rollout["next", "reward"]).all())


def test_skrl_steps_the_batch() -> None:
    library = pytest.importorskip("skrl.envs.wrappers.torch")
    envs = library.wrap_env(make(num_envs=3), wrapper="gymnasium", verbose=False)
    observation, _ = envs.reset()
    assert observation.shape == (3, 42)
    action = torch.rand(3, 9, generator=generator(0)) - 0.5
    observation, reward, terminated, truncated, _ = envs.step(action)
    assert observation.shape == (3, 42) and reward.shape == terminated.shape == truncated.shape == (3, 1)
    assert bool(torch.isfinite(reward).all())
