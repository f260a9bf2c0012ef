"""The batch: spaces, determinism, rows that never meet, and the three ways to reset."""

from __future__ import annotations

from typing import Any

import gymnasium
import numpy as np
import pytest
import torch
from gymnasium.vector import AutoresetMode
from hypothesis import given, settings
from hypothesis import strategies as st

from apcc_torch.envs import TruncatedReason
from apcc_torch.errors import ApccError, ConfigError, DtypeError, ShapeError, ValueRangeError
from arm_rows import IDS, actions, make, state_rows
from laws import bits

ALL = {"lengths": (0.9, 1.1), "stiffness": (0.8, 1.2), "noise": (0.0, 2e-3), "delay": (0, 2)}
MODES = ("configuration_velocity", "task_velocity", "tendon_lengths", "adaptation")
BOTH = ("kinematic", "dynamic")


def same(a: list[torch.Tensor], b: list[torch.Tensor]) -> bool:
    return all(torch.equal(bits(x), bits(y)) for x, y in zip(a, b, strict=True))


def run(envs: Any, steps: int, seed: int = 0) -> list[torch.Tensor]:
    observation, _ = envs.reset(seed=seed)
    seen = [observation]
    for k in range(steps):
        observation, reward, terminated, truncated, info = envs.step(actions(envs, k))
        seen += [observation, reward, terminated, truncated, *info.values()]
    return seen


@pytest.mark.parametrize("name", IDS)
@pytest.mark.parametrize("dynamics", BOTH)
@pytest.mark.parametrize("action", MODES)
def test_spaces_and_types(name: str, dynamics: str, action: str) -> None:
    envs = make(name, 3, dynamics=dynamics, action=action, **ALL)
    observation, info = envs.reset(seed=0)
    assert observation.numpy() in envs.observation_space and info["error"].shape == (3,)
    observation, reward, terminated, truncated, info = envs.step(envs.action_space.sample())
    assert observation.numpy() in envs.observation_space and observation.dtype == torch.float32
    assert reward.shape == (3,) and reward.dtype == torch.float32 and bool(torch.isfinite(reward).all())
    assert terminated.dtype == truncated.dtype == torch.bool and not bool((terminated | truncated).any())
    assert envs.state is not None and envs.state.q_d.dtype == torch.float64


def test_make_vec_takes_the_native_batch_and_its_time_limit() -> None:
    envs = gymnasium.make_vec("apcc/Reach-v0", num_envs=2)
    assert type(envs).__name__ == "ReachVectorEnv" and envs.metadata["autoreset_mode"] is AutoresetMode.NEXT_STEP
    assert envs.spec is not None and envs.spec.kwargs["vectorization_mode"] == "vector_entry_point"
    assert envs.simulator.max_episode_steps == envs.spec.max_episode_steps == 300  # type: ignore[attr-defined]
    copies = gymnasium.make_vec("apcc/Reach-v0", num_envs=2, vectorization_mode="sync")
    assert copies.reset(seed=0)[0].shape == (2, 42)


@pytest.mark.parametrize("dynamics", BOTH)
def test_a_seed_decides_everything(dynamics: str) -> None:
    first, again, other = (run(make(dynamics=dynamics, **ALL), 5, seed) for seed in (3, 3, 4))
    assert same(first, again) and not same(first, other)


def test_a_row_draws_the_same_in_any_batch() -> None:
    few, many = make(num_envs=3, **ALL), make(num_envs=40, **ALL)
    few.reset(seed=5), many.reset(seed=5)
    assert few.state is not None and many.state is not None
    assert same(list(few.state.rows), [drawn[:3] for drawn in many.state.rows])


@settings(max_examples=12)
@given(st.lists(st.booleans(), min_size=6, max_size=6).filter(any), st.sampled_from(BOTH))
def test_a_masked_reset_touches_no_other_row(mask: list[bool], dynamics: str) -> None:
    """Not a bit of the others' states, observations and random numbers differs, then or later."""
    one, other = (make(dynamics=dynamics, **ALL) for _ in range(2))
    reset, kept = torch.tensor(mask), ~torch.tensor(mask)
    for envs in (one, other):
        run(envs, 2)
    before = state_rows(one, kept)
    observation, _ = one.reset(options={"reset_mask": np.array(mask)})
    assert one.state is not None and other.state is not None
    assert same(before, state_rows(one, kept)) and one.state.step[reset].eq(0).all()
    assert not bool((one.state.rows.payload == other.state.rows.payload)[reset].any())
    assert torch.equal(observation[kept], other._view.observation[kept])  # type: ignore[union-attr]
    for k in range(3):
        one.step(actions(one, k)), other.step(actions(other, k))
    assert same(state_rows(one, kept), state_rows(other, kept))


def test_a_masked_reset_with_a_seed_starts_that_seeds_streams() -> None:
    one, other = make(**ALL), make(**ALL)
    run(one, 3, seed=0), other.reset(seed=9)
    mask = torch.tensor([True, False, False, True, False, False])
    one.reset(seed=9, options={"reset_mask": mask})
    assert same(state_rows(one, mask), state_rows(other, mask))


@pytest.mark.parametrize("dynamics", BOTH)
def test_next_step(dynamics: str) -> None:
    envs = make(dynamics=dynamics, max_episode_steps=3, autoreset_mode="NEXT_STEP")
    envs.reset(seed=0)
    for _ in range(3):
        last, _, _, truncated, info = envs.step(actions(envs))
    assert bool(truncated.all()) and info["truncated_reason"].tolist() == [TruncatedReason.TIME_LIMIT] * 6
    observation, reward, terminated, truncated, _ = envs.step(actions(envs))
    assert envs.state is not None and envs.state.step.tolist() == [0] * 6
    assert reward.tolist() == [0.0] * 6 and not bool((terminated | truncated).any())
    assert not torch.equal(observation, last)


def test_same_step() -> None:
    ended, plain = make(max_episode_steps=3, autoreset_mode="SAME_STEP"), make(max_episode_steps=9)
    ended.reset(seed=0), plain.reset(seed=0)
    for _ in range(3):
        observation, reward, _, truncated, info = ended.step(actions(ended))
        want, want_reward, _, _, want_info = plain.step(actions(plain))
    assert bool(truncated.all()) and torch.equal(info["final_obs"], want) and torch.equal(reward, want_reward)
    assert torch.equal(info["final_info"]["error"], want_info["error"]) and bool(info["_final_obs"].all())
    assert ended.state is not None and ended.state.step.tolist() == [0] * 6
    fresh = ended.simulator.view(ended.state)
    assert torch.equal(observation, fresh.observation) and torch.equal(info["error"], fresh.error.float())
    _, _, _, truncated, info = ended.step(actions(ended))
    assert not bool(truncated.any()) and "final_obs" not in info


def test_disabled() -> None:
    envs = make(max_episode_steps=2, autoreset_mode="DISABLED")
    envs.reset(seed=0)
    envs.step(actions(envs))
    envs.reset(options={"reset_mask": torch.arange(6) < 2})
    _, _, _, truncated, _ = envs.step(actions(envs))
    assert truncated.tolist() == [False, False, True, True, True, True]
    with pytest.raises(ConfigError, match="rows that are done must be reset"):
        envs.step(actions(envs))
    envs.reset(options={"reset_mask": truncated})
    _, _, _, truncated, _ = envs.step(actions(envs))
    assert truncated.tolist() == [True, True, False, False, False, False]


@pytest.mark.parametrize("action", MODES)
@pytest.mark.parametrize("dynamics", BOTH)
def test_a_row_that_goes_wrong_is_truncated_and_harms_nobody(dynamics: str, action: str) -> None:
    one, other = (make(dynamics=dynamics, action=action, autoreset_mode="DISABLED", **ALL) for _ in range(2))
    for envs in (one, other):
        envs.reset(seed=0)
        envs.step(actions(envs))
    bad = actions(one, 1)
    bad[2, 0] = torch.nan
    observation, reward, _, truncated, info = one.step(bad)
    want, want_reward, _, _, _ = other.step(actions(other, 1))
    assert truncated.tolist() == [i == 2 for i in range(6)]
    assert info["truncated_reason"].tolist() == [2 * (i == 2) for i in range(6)]
    good = torch.arange(6) != 2
    assert torch.equal(observation[good], want[good]) and torch.equal(reward[good], want_reward[good])
    assert bool(torch.isfinite(observation).all()) and bool(torch.isfinite(reward).all())
    assert same(state_rows(one, good), state_rows(other, good))


def test_a_row_that_leaves_its_bounds_is_truncated() -> None:
    envs = make(dynamics="dynamic")
    envs.reset(seed=0)
    assert envs.state is not None
    qdot = envs.state.arm.arm.qdot.clone()  # type: ignore[union-attr]
    qdot[4] = 1e7
    arm = envs.state.arm._replace(arm=envs.state.arm.arm._replace(qdot=qdot))  # type: ignore[union-attr]
    envs.state = envs.state._replace(arm=arm)
    observation, _, _, truncated, info = envs.step(actions(envs))
    assert truncated.tolist() == [i == 4 for i in range(6)] and bool(torch.isfinite(observation).all())
    assert int(info["truncated_reason"][4]) in (TruncatedReason.DIVERGED, TruncatedReason.NOT_FINITE)
    _, _, _, truncated, _ = envs.step(actions(envs))  # it resets, the others go on
    assert envs.state.step.tolist() == [2, 2, 2, 2, 0, 2] and not bool(truncated.any())


@pytest.mark.parametrize("dynamics", BOTH)
def test_a_row_whose_model_runs_away_is_truncated_alone(dynamics: str) -> None:
    given: dict[str, Any] = {"divergence": {"elongation": 0.3}, "estimate": (1.0, 1.0), "autoreset_mode": "DISABLED"}
    one, other = (make(action="adaptation", dynamics=dynamics, **given) for _ in range(2))
    for envs in (one, other):
        envs.reset(seed=0)
        envs.step(actions(envs))
    assert one.state is not None and one.state.controller is not None
    # A model that is too short has to stretch to reach the sensors.
    pi_hat = one.state.controller.pi_hat.clone()
    pi_hat[3] *= 0.7
    one.state = one.state._replace(controller=one.state.controller._replace(pi_hat=pi_hat))
    _, _, _, truncated, info = one.step(actions(one, 1))
    other.step(actions(other, 1))
    assert truncated.tolist() == [i == 3 for i in range(6)]
    assert int(info["truncated_reason"][3]) == TruncatedReason.DIVERGED
    good = torch.arange(6) != 3
    assert same(state_rows(one, good), state_rows(other, good))


@pytest.mark.parametrize("dynamics", BOTH)
def test_single_precision_follows_double(dynamics: str) -> None:
    ends = [run(make(dynamics=dynamics, dtype=dtype, **ALL), 20)[-7] for dtype in ("float32", "float64")]
    assert float((ends[0][:, :9] - ends[1][:, :9]).abs().max()) < 1e-4


@pytest.mark.parametrize(
    ("given", "error", "message"),
    [
        ({"dynamics": "quasi"}, ConfigError, "dynamics must be one of kinematic, dynamic, got 'quasi'"),
        ({"dtype": "float16"}, ConfigError, "dtype must be one of float64, float32, got 'float16'"),
        ({"autoreset_mode": "LATER"}, ConfigError, "autoreset_mode must be one of NEXT_STEP"),
        ({"control_rate": 0.0}, ValueRangeError, "control_rate must be positive and finite, got 0.0"),
        ({"plant": {"substeps": 0}}, ValueRangeError, r"plant\.substeps must be in \[1, 10000\], got 0"),
        ({"plant": {"substep": 2}}, ConfigError, r"plant\.substep is no setting; did you mean substeps\?"),
        ({"control": {"gama": 2.0}}, ConfigError, "a controller has no setting 'gama'; did you mean gamma\\?"),
        ({"control": {"adaptation": None}, "action": "adaptation"}, ConfigError, "adaptation must be an AdaptiveLaw"),
        ({"payloads": (0.0, 1.0)}, ConfigError, "ReachEnv has no setting 'payloads'; did you mean payload\\?"),
        ({"bend_rate": torch.tensor(1.0)}, ConfigError, "bend_rate must be a number"),
        ({"num_envs": 0}, ValueRangeError, "num_envs must be at least 1 and finite, got 0"),
        ({"num_envs": -1}, ValueRangeError, "num_envs must be at least 1 and finite, got -1"),
        ({"num_envs": 1.5}, ConfigError, r"num_envs must be a whole number, got 1\.5"),
        ({"num_envs": True}, ConfigError, "num_envs must be a whole number, got True"),
        ({"render_mode": "ansi"}, ConfigError, "render_mode must be one of rgb_array, got 'ansi'"),
    ],
)
def test_bad_arguments(given: dict[str, Any], error: type[ApccError], message: str) -> None:
    with pytest.raises(error, match=message):
        make(**given)


def test_bad_calls() -> None:
    envs = make()
    with pytest.raises(ConfigError, match="reset must be called"):
        envs.step(torch.zeros(6, 9))
    envs.reset(seed=0)
    with pytest.raises(ShapeError, match=r"actions must have shape \(6, 9\), got \(6, 3\)"):
        envs.step(torch.zeros(6, 3))
    for none in (None, "forward", {"a": 1}, torch.ones(6, 9).bool()):
        with pytest.raises(DtypeError, match="actions must be numbers, got"):
            envs.step(none)  # type: ignore[arg-type]
    for mask, error in (
        (torch.ones(6), DtypeError),
        (torch.ones(5).bool(), ShapeError),
        ([False] * 6, ValueRangeError),
    ):
        with pytest.raises(error, match="reset_mask must"):
            envs.reset(options={"reset_mask": mask})
