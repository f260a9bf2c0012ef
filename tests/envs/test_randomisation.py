"""Ranges: what is drawn stays in them, fills them, and is refused where it makes no sense."""

from __future__ import annotations

from typing import Any

import pytest
import torch

from apcc_torch.envs.randomisation import Ranges
from apcc_torch.envs.streams import streams
from apcc_torch.errors import ConfigError, ValueRangeError
from arm_rows import make

CPU = torch.device("cpu")


def test_draws_fill_their_ranges() -> None:
    ranges = Ranges(
        lengths=(0.9, 1.2),
        stiffness=(0.5, 2.0),
        payload=(0.1, 0.4),
        noise=(0.0, 1e-3),
        delay=(1, 3),
        estimate=(0.8, 0.9),
    )
    _, rows = ranges.draw(streams(0, 4000, CPU), 3, torch.float64)
    for name in ("lengths", "stiffness", "payload", "noise", "estimate"):
        low, high = getattr(ranges, name)
        drawn, width = getattr(rows, name), high - low
        assert low <= float(drawn.min()) < low + 0.01 * width and high - 0.01 * width < float(drawn.max()) <= high
        assert float(drawn.mean()) == pytest.approx(0.5 * (low + high), abs=0.03 * width)
    assert torch.bincount(rows.delay).tolist()[0] == 0
    assert [n / 4000 for n in torch.bincount(rows.delay).tolist()[1:]] == pytest.approx([1 / 3] * 3, abs=0.03)


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ({"payload": (0.5, 0.1)}, r"payload must be a range \(low, high\) with low <= high, got \(0.5, 0.1\)"),
        ({"payload": (-0.1, 0.1)}, "payload must be zero or positive and finite, got -0.1"),
        ({"lengths": (0.0, 1.0)}, r"lengths must be at least 0\.1 and finite, got 0"),
        ({"noise": 0.001}, r"noise must be a range \(low, high\) with low <= high, got 0.001"),
        ({"noise": (0.0, float("nan"))}, "noise must be zero or positive and finite, got nan"),
        ({"delay": (0, 1.5)}, "delay must be a list of whole numbers"),
    ],
)
def test_bad_ranges(given: dict[str, Any], message: str) -> None:
    with pytest.raises((ConfigError, ValueRangeError), match=message):
        make(**given)


def test_every_episode_draws_anew() -> None:
    envs = make()
    envs.reset(seed=0)
    assert envs.state is not None
    first = envs.state.rows.payload
    envs.reset()
    assert not bool((first == envs.state.rows.payload).any())
