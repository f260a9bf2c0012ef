"""The examples that learn do so in their reduced form already: a few thousand steps bring the tip nearer."""

from __future__ import annotations

import re

import pytest

from commands import example

NEEDS = {"ppo_reach.py": "torch", "skrl_reach.py": "skrl", "torchrl_reach.py": "torchrl"}


@pytest.mark.parametrize("name", NEEDS)
def test_quick(name: str) -> None:
    pytest.importorskip(NEEDS[name])
    told = "\n".join(example(name, "--threads", "1"))
    errors = {
        what.strip(): float(error) for what, error in re.findall(r"^(.*?) +return.*error +([\d.]+) mm", told, re.M)
    }
    assert len(errors) == 7, told
    *learning, idle, random, learnt = errors.values()
    assert learnt == learning[-1] < 0.8 * min(learning[0], idle, random), told
