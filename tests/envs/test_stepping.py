"""Environments in machine code: what they return, draw, truncate and reset is what torch has, step by step."""

from __future__ import annotations

import logging
from typing import Any

import pytest
import torch
from torch import Tensor

from apcc_torch import Arm
from apcc_torch.envs.prepared import Draw, Prepared
from apcc_torch.envs.stepping import ByMachineCode, ByTorch
from apcc_torch.envs.streams import streams
from apcc_torch.errors import CompileError, ValueRangeError
from apcc_torch.model.arm_placement import Placement
from arm_rows import IDS, actions, make, state_rows
from laws import leaves

SMALL = Arm(lengths=[0.3], mass=0.4)
PLANT = {"refine": 1}
DRAWN = {"lengths": (0.9, 1.1), "stiffness": (0.8, 1.2), "noise": (0.0, 2e-3), "delay": (0, 2)}


def agree(have: Any, want: Any, tolerance: float) -> None:
    """Of all that a step or a reset returns: values within rounding, whatever is told apart exactly."""
    assert have.keys() == want.keys() if isinstance(have, dict) else True
    for a, b in zip(leaves(values(have)), leaves(values(want)), strict=True):
        assert a.dtype == b.dtype and a.shape == b.shape
        if a.is_floating_point():
            torch.testing.assert_close(a, b, rtol=tolerance, atol=tolerance, equal_nan=True)
        else:
            assert torch.equal(a, b)


def values(item: Any) -> Any:
    """Dictionaries as tuples of what they hold."""
    if isinstance(item, dict):
        return tuple(values(item[key]) for key in sorted(item))
    return tuple(map(values, item)) if type(item) is tuple else item


def run_both(steps: int, tolerance: float, name: str = IDS[0], **given: Any) -> None:
    """The same actions, one of them not a number, some rows reset in between."""
    settings: dict[str, Any] = {"arm": SMALL, "num_envs": 11, "max_episode_steps": 3, **given}
    fast, plain = make(name, compile="aot", **settings), make(name, compile="off", **settings)
    assert isinstance(fast._stepping, ByMachineCode) and isinstance(plain._stepping, ByTorch)
    agree(fast.reset(seed=3), plain.reset(seed=3), tolerance)
    for k in range(steps):
        action = actions(plain, k)
        action[k % 11] = torch.nan if k < 2 else torch.inf
        agree(fast.step(action), plain.step(action), tolerance)
        if k == 1:
            mask = torch.arange(11) == 4
            before = state_rows(fast, ~mask)
            agree(*(e.reset(options={"reset_mask": mask}) for e in (fast, plain)), tolerance)
            assert all(map(torch.equal, before, state_rows(fast, ~mask)))
    agree(tuple(leaves(fast.state)), tuple(leaves(plain.state)), tolerance)


@pytest.mark.parametrize("mode", ["NEXT_STEP", "SAME_STEP"])
def test_the_kinematic_arm(mode: str) -> None:
    run_both(7, 1e-6, autoreset_mode=mode, **DRAWN)


@pytest.mark.parametrize(("name", "action"), [(IDS[1], "task_velocity"), (IDS[2], "tendon_lengths")])
def test_the_other_tasks_and_actions(name: str, action: str) -> None:
    run_both(4, 1e-6, name, action=action)


def test_the_dynamic_arm() -> None:
    run_both(7, 1e-6, dynamics="dynamic", plant=PLANT, autoreset_mode="SAME_STEP", **DRAWN)


def test_single_precision_is_torchs_to_its_rounding() -> None:
    run_both(7, 2e-5, dtype="float32", **DRAWN)
    run_both(7, 1e-4, dtype="float32", dynamics="dynamic", plant=PLANT)


def test_one_arm_and_arms_that_lean() -> None:
    """A leaning dynamic arm finds its rest by torch; one row runs as one number at a time."""
    leaning = SMALL.changed(placement=Placement(gravity=(3.0, 0.0, -9.0)))
    given: dict[str, Any] = {"arm": leaning, "num_envs": 1, "dynamics": "dynamic", "plant": PLANT}
    fast, plain = make(compile="aot", **given), make(**given)
    agree(fast.reset(seed=1), plain.reset(seed=1), 1e-6)
    for k in range(3):
        agree(fast.step(actions(plain, k)), plain.step(actions(plain, k)), 1e-6)


def test_a_rows_numbers_do_not_depend_on_the_others() -> None:
    few, many = (make(compile="aot", arm=SMALL, num_envs=n, max_episode_steps=3, **DRAWN) for n in (3, 11))
    few.reset(seed=5), many.reset(seed=5)
    for k in range(5):
        action = actions(many, k)
        have, want = few.step(action[:3]), many.step(action)
        assert torch.equal(have[0], want[0][:3]) and torch.equal(have[1], want[1][:3])


def test_what_is_returned_is_the_learners() -> None:
    envs, again = (make(compile="aot", arm=SMALL, num_envs=11, max_episode_steps=3, **DRAWN) for _ in range(2))
    envs.reset(seed=0), again.reset(seed=0)
    for k in range(5):
        returned, want = envs.step(actions(envs, k)), again.step(actions(envs, k))
        agree(returned[:4], want[:4], 0.0)
        for tensor in leaves(values(returned)):
            tensor.fill_(1)
    mask = torch.arange(11) == 2
    agree(*(e.reset(options={"reset_mask": mask}) for e in (envs, again)), 0.0)


def test_prepared_numbers_are_the_streams() -> None:
    stream = streams(7, 4, torch.device("cpu"))
    later, given = Prepared.of(stream, [Draw(False, 3), Draw(True, 2)], torch.float32)
    first, uniform = stream.uniform(3, torch.float32)
    second, normal = first.normal(2, torch.float32)
    assert torch.equal(later.drawn, second.drawn) and torch.equal(given.drawn, stream.drawn)
    rest, a = given.uniform(3, torch.float32)
    _, b = rest.normal(2, torch.float32)
    assert torch.equal(a, uniform) and torch.equal(b, normal)


def test_modes(monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture) -> None:
    with pytest.raises(ValueRangeError, match="compile must be one of off, inductor, aot, auto, got 'jit'"):
        make(compile="jit", arm=SMALL)
    # As before there were others.
    assert all(isinstance(make(compile=given, arm=SMALL)._stepping, ByTorch) for given in (True, False, "inductor"))
    monkeypatch.setenv("CXX", "no-such-compiler")
    with caplog.at_level(logging.WARNING):
        envs = make(compile="auto", arm=SMALL)
    assert isinstance(envs._stepping, ByTorch)
    assert "the environment's step is not compiled and runs eagerly: no C++ compiler" in caplog.text
    with pytest.raises(CompileError, match="the environment's step is not compiled; compile=auto or off runs it eager"):
        make(compile="aot", arm=SMALL)
    observation: Tensor = envs.reset(seed=0)[0]
    assert torch.equal(observation, make(arm=SMALL).reset(seed=0)[0])


def test_an_earlier_state_is_taken_up_again() -> None:
    envs = make(compile="aot", arm=SMALL, num_envs=11, max_episode_steps=3, **DRAWN)
    envs.reset(seed=0)
    kept = envs.state
    first = envs.step(actions(envs, 1))
    envs.step(actions(envs, 2))
    envs.state = kept
    agree(envs.step(actions(envs, 1))[:2], first[:2], 0.0)
