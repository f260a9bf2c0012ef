"""One step as a pure function: nothing in it asks for a value, nothing it is given is written to."""

from __future__ import annotations

from typing import Any

import pytest
import torch

from apcc_torch.control.lookahead_settings import LookaheadSettings
from arm_rows import actions, make
from laws import bits, leaves

DRAWN = {"lengths": (0.9, 1.1), "noise": (0.0, 1e-3), "delay": (0, 2)}
AHEAD = {"dynamics": "dynamic", "action": "adaptation", "control": {"lookahead": LookaheadSettings(samples=4, steps=2)}}


@pytest.mark.parametrize(
    "given",
    [{}, {"action": "task_velocity"}, {"action": "adaptation"}, {"dynamics": "dynamic", **DRAWN}, AHEAD],
    ids=["default", "task_velocity", "adaptation", "dynamic_drawn", "ahead"],
)
def test_a_step_is_one_graph(given: dict[str, Any]) -> None:
    """torch's compiler traces it whole, without a break, and the traced step gives the same bits."""
    envs = make(num_envs=256, **given)  # so many that small systems are solved alike, see `linalg`
    envs.reset(seed=0)
    step = torch.compile(envs.simulator, backend="eager", fullgraph=True, dynamic=False)
    with torch.no_grad():
        traced, plain = (leaves(f(envs.state, actions(envs))) for f in (step, envs.simulator))
    assert all(torch.equal(bits(a), bits(b)) for a, b in zip(traced, plain, strict=True))


@pytest.mark.parametrize("dynamics", ["kinematic", "dynamic"])
def test_a_step_writes_into_nothing(dynamics: str) -> None:
    envs = make(num_envs=4, dynamics=dynamics, **DRAWN)
    envs.reset(seed=0)
    action = actions(envs)
    before = [leaf.clone() for leaf in [*leaves(envs.state), action]]
    envs.simulator(envs.state, action)
    assert all(torch.equal(bits(a), bits(b)) for a, b in zip(before, [*leaves(envs.state), action], strict=True))


def test_what_is_returned_stays_what_it_was() -> None:
    envs = make(num_envs=4, max_episode_steps=3)
    observation, info = envs.reset(seed=0)
    kept = [observation, *leaves(list(info.values()))]
    was = [leaf.clone() for leaf in kept]
    for k in range(5):
        later = envs.step(actions(envs, k))
        later[0].fill_(7.0)  # a learner may write into what it is given
        assert not bool((envs.step(actions(envs, k))[0] == 7.0).any())
    assert all(torch.equal(a, b) for a, b in zip(kept, was, strict=True))
