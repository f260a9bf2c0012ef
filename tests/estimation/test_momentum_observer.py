"""The momentum observer: the filter it promises to be, on an arm that moves."""

from __future__ import annotations

import math

import pytest
import torch

from apcc_torch.errors import ValueRangeError
from apcc_torch.estimation.momentum_observer import MomentumObserver
from apcc_torch.model.backbone import PCCBackbone
from apcc_torch.model.integrators import Actuation, ArmState, semi_implicit_step
from apcc_torch.native.function import NativeFunction
from arms import HANGING_BASE, PI
from laws import bits
from resting_arms import ROUTING, arm

D = torch.float64
FORCE = torch.tensor([0.6, -0.3, -1.0], dtype=D)
GAIN, BEGINS = 20.0, 0.5


def swing(dt: float, duration: float) -> list[tuple[torch.Tensor, ...]]:
    """(filtered tau_ext, r, estimated tip force) at every step of an arm that its tendons shake.

    A force acts from `BEGINS` on; what is filtered is its generalized force, by the filter that is promised.
    """
    dynamics = arm(damping_ratio=0.1)
    observer = MomentumObserver(dynamics, ROUTING, gain=GAIN)
    backbone = PCCBackbone(3, HANGING_BASE)
    state = ArmState(torch.zeros(9, dtype=D), torch.zeros(9, dtype=D))
    memory, filtered = observer.initial_state(state.q), torch.zeros(9, dtype=D)
    log = []
    for k in range(round(duration / dt)):
        u = -2.0 + 0.8 * torch.sin(torch.arange(9, dtype=D) + 3.0 * k * dt)
        f = FORCE if k * dt >= BEGINS else torch.zeros(3, dtype=D)
        memory = observer(memory, state.q, state.qdot, u, dt)
        tau_ext = backbone.tip_jacobian(state.q, PI).mT @ f
        found = observer.load(memory, state.q, 1e-4 * torch.eye(9, dtype=D), payload=False)
        log.append((filtered, memory.r, found.value))
        filtered = filtered + dt * GAIN * (tau_ext - filtered)
        actuation = Actuation(ROUTING.generalized_force(u, PI))
        state = semi_implicit_step(dynamics, state, actuation, dt, wrench=torch.nn.functional.pad(f, (3, 0)))
    return log


def test_it_is_the_promised_filter_of_the_force() -> None:
    dt = 2e-3
    log = swing(dt, 0.8)
    for filtered, r, _ in log:
        torch.testing.assert_close(r, filtered, rtol=0.0, atol=0.08)
    after = log[round((BEGINS + 1.0 / GAIN) / dt)]
    share = float(after[2].norm() / FORCE.norm())
    assert abs(share - (1.0 - math.exp(-1.0))) < 0.1
    # What is left is the lag in an arm that turns.
    torch.testing.assert_close(log[-1][2], FORCE, rtol=0.0, atol=0.25)


def test_its_error_falls_with_the_step() -> None:
    errors = []
    for dt in (8e-3, 4e-3, 2e-3):
        log = swing(dt, 0.4)
        errors.append(max(float(r.abs().max()) for _, r, _ in log))
    assert errors[2] < 0.6 * errors[1] < 0.4 * errors[0]


def test_at_rest_it_weighs_the_payload() -> None:
    dynamics = arm(damping_ratio=0.1)
    observer = MomentumObserver(dynamics, ROUTING, gain=GAIN)
    q = torch.tensor([0.2, -0.1, 0.01, 0.3, 0.2, 0.0, -0.2, 0.1, 0.01], dtype=D).expand(2, 9)
    payload = torch.tensor([0.1, 0.3], dtype=D)
    hold = dynamics.gravity(q, payload) + dynamics.stiffness_diagonal * q
    u = torch.linalg.solve(ROUTING.matrix(PI), hold.unsqueeze(-1)).squeeze(-1)
    state = observer.initial_state(q)
    for _ in range(200):
        state = observer(state, q, torch.zeros_like(q), u, 0.02)
    found = observer.load(state, q, 1e-4 * torch.eye(9, dtype=D))
    torch.testing.assert_close(found.value[:, 0], payload, rtol=1e-5, atol=1e-7)


def test_guides_that_drag_are_known() -> None:
    """Their drag, given to the tendons on top, leaves r as it is without it."""
    q, qdot = torch.full((9,), 0.1, dtype=D), torch.linspace(-0.5, 0.5, 9, dtype=D)
    u = torch.linspace(-6.0, -2.0, 9, dtype=D)
    drag = 15.0 * (ROUTING.matrix(PI).mT @ qdot)
    runs = []
    for friction, forces in ((0.0, u), (15.0, u + drag)):
        observer = MomentumObserver(arm(), ROUTING, GAIN, tendon_damping=friction)
        state = observer.initial_state(q)
        for _ in range(3):
            state = observer(state, q, qdot, forces, 1e-3)
        runs.append(state.r)
    torch.testing.assert_close(runs[0], runs[1])


def test_rows_do_not_mix() -> None:
    observer = MomentumObserver(arm(), ROUTING, GAIN)
    q = 0.1 * torch.ones(2, 9, dtype=D)
    u = -torch.ones(2, 9, dtype=D)
    good = observer(observer.initial_state(q), q, q, u, 1e-3)
    bad = q.clone()
    bad[0] = torch.nan
    ill = observer(observer.initial_state(q), bad, q, u, 1e-3)
    assert torch.equal(bits(good.r[1]), bits(ill.r[1])) and bool(ill.r[0].isnan().all())


def test_it_runs_as_machine_code() -> None:
    """One sample after the other, as a loop takes them."""
    observer = MomentumObserver(arm(damping_ratio=0.1), ROUTING, GAIN, tendon_damping=15.0)
    q, u = 0.1 * torch.ones(2, 9, dtype=D), -torch.ones(2, 9, dtype=D)
    state, dt = observer.initial_state(q), torch.tensor(0.01, dtype=D)
    with torch.no_grad():
        native = NativeFunction(observer, (observer.initial_state(q[0]), q[0], q[0], u[0], dt))
        for k in range(3):
            qdot = 0.3 * torch.cos(torch.arange(9, dtype=D) + k).expand(2, 9)
            state, had = observer(state, q, qdot, u, dt), state
            for have, want in zip(native(had, q, qdot, u, dt), state, strict=True):
                torch.testing.assert_close(have, want, rtol=1e-9, atol=1e-12)


def test_bad_settings_are_named() -> None:
    with pytest.raises(ValueRangeError, match="gain"):
        MomentumObserver(arm(), ROUTING, gain=0.0)
