"""The error that the loop acts on under a load: as it will be, and no swinging about a target that is hard to hold."""

from __future__ import annotations

import math

import pytest
import torch
from torch import Tensor

from apcc_torch import Arm, compose
from apcc_torch.control.shape_law import ShapeLawSettings
from apcc_torch.estimation.shape_feedback import FollowedShape, ShapeFeedback
from apcc_torch.experiments.dynamic import curves, simulate

D = torch.float64
ARM = Arm(lengths=[0.2, 0.25], mass=0.5)
NOISE = 1e-3
"""m, `position_noise` as it is."""


def feedback() -> ShapeFeedback:
    return ShapeFeedback.on(ARM, ARM.backbone(), ShapeLawSettings())


def bearing(of: ShapeFeedback, load: Tensor) -> FollowedShape:
    """Before the first step, with a load (...) that is known."""
    q = torch.zeros(*load.shape, 6, dtype=D)
    state = of.initial_state(q, ARM.rest_lengths().expand(*load.shape, 2))
    return state._replace(shape=state.shape._replace(load=load))


def moved(
    of: ShapeFeedback, state: FollowedShape, velocity: Tensor, xdot_d: Tensor, dt: float, steps: int
) -> tuple[FollowedShape, Tensor]:
    """The error that is seen ahead of one of nothing, after steps of a tip that moves at a velocity (..., 3)."""
    none = torch.zeros_like(velocity)
    seen = none
    for k in range(steps):
        time = torch.full(velocity.shape[:-1], dt, dtype=D)
        state, seen = of.ahead(state, k * dt * velocity, none, xdot_d.expand_as(velocity), time)
    return state, seen


def test_a_moving_tip_is_seen_where_it_will_be_less_what_noise_explains() -> None:
    of, load = feedback(), torch.tensor([0.0, 0.25, 0.5], dtype=D)
    velocity, none = torch.tensor([0.06, 0.0, -0.08], dtype=D), torch.zeros(3, dtype=D)
    dt = 1e-3
    _, seen = moved(of, bearing(of, load), velocity.expand(3, 3), none, dt, 4000)
    for row, m in zip(seen, load, strict=True):
        T = float(m) / 0.5 * math.sqrt(0.45 / 9.81)
        # Behind the low-pass that is solved exactly over a step, a ramp is late by dt / (e^(dt / T) - 1).
        late = 0.1 * dt / (math.exp(dt / T) - 1.0) if T else 0.0
        want = -max(late - 2.0 * NOISE, 0.0) * velocity / 0.1
        torch.testing.assert_close(row, want, rtol=1e-7, atol=1e-15)


def test_noise_alone_and_the_first_step_change_nothing() -> None:
    of, e = feedback(), torch.tensor([3e-3, -1e-3, 2e-3], dtype=D)
    state, none, dt = bearing(of, torch.tensor(0.5, dtype=D)), torch.zeros(3, dtype=D), torch.tensor(0.01, dtype=D)
    state, seen = of.ahead(state, torch.tensor([0.1, 0.2, -0.3], dtype=D), e, none, dt)
    assert torch.equal(seen, e), "before there are two samples, nothing moves"
    for sign in (1.0, -1.0, 1.0):
        state, seen = of.ahead(state, torch.tensor([0.1 + sign * NOISE, 0.2, -0.3], dtype=D), e, none, dt)
        assert torch.equal(seen, e)


def test_a_tip_that_moves_with_its_target_is_not_braked() -> None:
    of, velocity = feedback(), torch.tensor([0.06, 0.0, -0.08], dtype=D)
    _, seen = moved(of, bearing(of, torch.tensor(0.5, dtype=D)), velocity, velocity, 1e-3, 4000)
    assert torch.equal(seen, torch.zeros(3, dtype=D))


def test_a_tip_of_which_nothing_is_known_leaves_what_was_known_of_it() -> None:
    of, none, dt = feedback(), torch.zeros(3, dtype=D), torch.tensor(0.01, dtype=D)
    state, _ = of.ahead(bearing(of, torch.tensor(0.5, dtype=D)), none + 0.1, none, none, dt)
    lost, _ = of.ahead(state, none + torch.nan, none, none, dt)
    assert torch.equal(lost.tip, state.tip)


def tips(ahead: bool) -> Tensor:
    """|e| (T,) of the paper's set-point with 1 kg at the tip, m."""
    words = ["experiment=dynamic_run_2_tuned", "experiment.setpoints=[[0.325,0.15,-0.275]]", "controller.rate=20"]
    words += ["experiment.payloads=[1.0]", "experiment.duration=8", "plant.substeps=5", "plant.settle=1"]
    with pytest.MonkeyPatch.context() as patch:
        if not ahead:
            patch.setattr(ShapeFeedback, "ahead", lambda self, state, x, e, xdot_d, dt: (state, e))
        outcome = simulate(compose(*words, "adaptation=shape", "progress=false", "figures=false").settings)
    return curves(outcome.log, outcome.arms).e[:, 0]


def test_an_arm_that_bears_as_much_as_it_weighs_comes_to_rest_where_its_stiffness_is_least() -> None:
    assert tips(True)[-20:].max() < 15e-3
    assert tips(False)[-20:].max() > 0.1, "on where the tip is, the loop swings"
