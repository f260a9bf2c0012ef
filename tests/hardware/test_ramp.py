"""Tendons on a given way: the ramp, and a controller that only looks on."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from apcc_torch.errors import ValueRangeError
from apcc_torch.hardware.ramp import Ramp, RampControl
from apcc_torch.hardware.sensing import GatedFrame
from fake_runs import builder, rest

GOAL = -0.01 * np.arange(9)


@given(time=st.floats(-5.0, 50.0))
def test_a_ramp_is_linear_and_then_level(time: float) -> None:
    y = Ramp(9, goal=GOAL.tolist(), duration=10.0).at(time)
    assert np.allclose(y, np.interp(time, [0.0, 10.0], [0.0, 1.0]) * GOAL, atol=1e-15)


def test_a_ramp_without_meaning_is_refused() -> None:
    with pytest.raises(ValueRangeError, match="duration must be positive"):
        Ramp(9, goal=GOAL.tolist(), duration=0.0)
    with pytest.raises(ValueRangeError, match="goal must be finite"):
        Ramp(9, goal=(GOAL * np.nan).tolist())


def test_the_lengths_are_the_ramps_and_the_controller_asks_for_nothing() -> None:
    build = builder()
    control = RampControl(
        build.controller(adaptive=False), build.first_estimate(), Ramp(9, goal=GOAL.tolist(), duration=10.0)
    )
    yes = np.ones(3, dtype=np.bool_)
    with torch.inference_mode():
        for k in range(5):
            frame = GatedFrame(0.01 * k, k, 0.0, rest(), yes, yes, 0 * yes, 0 * yes, True)
            decision = control.decide(frame, control.ramp.at(0.5 * k), 0.5 * (k + 1))
            assert np.allclose(decision.y, GOAL * 0.05 * (k + 1))
            assert np.abs(decision.e).max() == 0.0 and np.abs(decision.q_bar).max() < 1e-3
