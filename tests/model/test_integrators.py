"""Time steps: order of convergence, conserved energy, stiff stability, and rows that diverge alone."""

from __future__ import annotations

import math

import pytest
import torch
from scipy.integrate import solve_ivp
from torch import Tensor

from apcc_torch.model.dynamics import SoftArmDynamics
from apcc_torch.model.integrators import (
    Actuation,
    ArmState,
    Guarded,
    guard,
    rk4_step,
    rosenbrock_step,
    semi_implicit_step,
)
from apcc_torch.model.stiffness import scaled_stiffness
from apcc_torch.model.tendons import rack_routing
from laws import bits, check_gradients, generator, normal

D = torch.float64
PLANT = torch.tensor([0.0525, 0.0525, 0.1275, 0.1275, 0.12, 0.12], dtype=D)


def arm(n_b: int = 2, ratio: float = 0.1) -> SoftArmDynamics:
    lengths = torch.linspace(0.12, 0.15, n_b, dtype=D)
    base = torch.diag(torch.tensor([1.0, -1.0, -1.0], dtype=D))
    axial, bending = scaled_stiffness(lengths)
    return SoftArmDynamics(lengths, 2.0 * lengths, axial, bending, ratio, base_rotation=base)


def field(dynamics: SoftArmDynamics):  # type: ignore[no-untyped-def]
    """dx/dt for x = (q, qdot) without actuation."""

    def call(t: Tensor, x: Tensor) -> Tensor:
        q, qdot = x.chunk(2, dim=-1)
        return torch.cat((qdot, dynamics(q, qdot, torch.zeros_like(q))), dim=-1)

    return call


def start(n: int, shape: tuple[int, ...] = (), seed: int = 0) -> Tensor:
    q = normal((*shape, n // 3, 3), D, generator(seed)) * torch.tensor([0.4, 0.4, 0.01], dtype=D)
    return torch.cat((q.flatten(-2), torch.zeros(*shape, n, dtype=D)), dim=-1)


def reference(f, x: Tensor, times: list[float], rtol: float, atol: float) -> Tensor:  # type: ignore[no-untyped-def]
    """States (T, m) at some times, the first that of x (m,), by another's adaptive steps."""

    def slope(t: float, y):  # type: ignore[no-untyped-def]
        return f(torch.tensor(t), torch.from_numpy(y)).numpy()

    run = solve_ivp(slope, (times[0], times[-1]), x.numpy(), method="DOP853", t_eval=times, rtol=rtol, atol=atol)
    assert run.success
    return torch.from_numpy(run.y.T)


def rollout(step, state: Tensor, n_steps: int) -> Guarded:  # type: ignore[no-untyped-def]
    """The trajectory (n_steps + 1, ..., m) of guarded steps, and when each row left it."""
    diverged_at = torch.full(state.shape[:-1], -1)
    states = [state]
    for k in range(n_steps):
        state, diverged_at = guard(state, step(k, state), diverged_at, k)
        states.append(state)
    return Guarded(torch.stack(states), diverged_at)


def orders(step, x: Tensor, want: Tensor, span: float, counts: tuple[int, ...]) -> list[float]:  # type: ignore[no-untyped-def]
    """Observed order between successive step counts."""
    errors = []
    for count in counts:
        dt = span / count
        state = x
        for k in range(count):
            state = step(k * dt, state, dt)
        errors.append(float((state - want).norm()))
    return [
        math.log(a / b) / math.log(m / n) for a, b, n, m in zip(errors, errors[1:], counts, counts[1:], strict=False)
    ]


def test_order_of_every_step() -> None:
    dynamics = arm(2, ratio=0.01)
    f, span = field(dynamics), 0.018
    x = start(6)
    want = reference(f, x, [0.0, span], rtol=1e-12, atol=1e-13)[-1]

    def free(state: ArmState) -> Actuation:
        return Actuation(torch.zeros_like(state.q))

    def euler(t: float, state: Tensor, dt: float) -> Tensor:
        now = ArmState(*state.chunk(2, dim=-1))
        return torch.cat(semi_implicit_step(dynamics, now, free(now), dt), dim=-1)

    def rosenbrock(t: float, state: Tensor, dt: float) -> Tensor:
        return torch.cat(rosenbrock_step(dynamics, ArmState(*state.chunk(2, dim=-1)), free, dt), dim=-1)

    assert all(
        abs(p - 4) < 0.3
        for p in orders(lambda t, s, dt: rk4_step(f, torch.tensor(t), s, dt), x, want, span, (12, 24, 48))
    )
    assert all(abs(p - 1) < 0.15 for p in orders(euler, x, want, span, (12, 24, 48)))
    assert all(abs(p - 2) < 0.2 for p in orders(rosenbrock, x, want, span, (12, 24, 48)))


def test_rk4_uses_its_times() -> None:
    # dx/dt = 4 t^3 is integrated exactly by a method of order 4.
    x = rk4_step(lambda t, x: (4.0 * t**3).expand_as(x), torch.tensor(0.5, dtype=D), torch.zeros(2, dtype=D), 0.5)
    torch.testing.assert_close(x, torch.full((2,), 1.0 - 0.5**4, dtype=D))


def test_the_free_arm_conserves_its_energy() -> None:
    dynamics = arm(2, ratio=0.0)
    runs = [reference(field(dynamics), x, [0.0, 0.05, 0.1], rtol=1e-8, atol=1e-9) for x in start(6, (2,))]
    energy = dynamics.energy(*torch.stack(runs, dim=1).chunk(2, dim=-1))
    total = energy.kinetic + energy.potential
    scale = energy.kinetic.amax(0)
    assert bool(((total - total[0]).abs() < 1e-6 * scale).all())


def pid(dynamics: SoftArmDynamics, lengths: Tensor, kp: float = 750.0, kd: float = 5.0):  # type: ignore[no-untyped-def]
    """The paper's tendon loop, as a force and its linearization."""
    matrix = rack_routing(torch.tensor([0.105, 0.36, 0.60], dtype=D)).matrix(lengths)
    target = 0.01 * torch.sin(torch.arange(9, dtype=D))

    def call(state: ArmState) -> Actuation:
        y, ydot = state.q @ matrix, state.qdot @ matrix
        u = kp * (target - y) - kd * ydot
        return Actuation(u @ matrix.mT, kp * matrix @ matrix.mT, kd * matrix @ matrix.mT)

    return call


def plant() -> SoftArmDynamics:
    axial, bending = scaled_stiffness(PLANT)
    base = torch.diag(torch.tensor([1.0, -1.0, -1.0], dtype=D))
    return SoftArmDynamics(PLANT, PLANT / 0.6, axial, bending, 0.1, base_rotation=base)


@pytest.mark.parametrize("dt", [2e-3, 5e-3])
def test_implicit_steps_are_stable_on_the_paper_arm(dt: float) -> None:
    dynamics = plant()
    loop = pid(dynamics, PLANT)
    payload = torch.tensor([0.0, 0.25, 0.5], dtype=D)

    def euler(k: int, x: Tensor) -> Tensor:
        now = ArmState(*x.chunk(2, dim=-1))
        return torch.cat(semi_implicit_step(dynamics, now, loop(now), dt, payload), dim=-1)

    def rosenbrock(k: int, x: Tensor) -> Tensor:
        return torch.cat(rosenbrock_step(dynamics, ArmState(*x.chunk(2, dim=-1)), loop, dt, payload), dim=-1)

    x = torch.zeros(3, 36, dtype=D)
    ends = [rollout(step, x, round(0.4 / dt)) for step in (euler, rosenbrock)]
    for end in ends:
        assert bool((end.diverged_at == -1).all())
        assert end.state[-1, :, 18:].abs().max() < 0.5
    # An explicit method of order 4 does not survive this step.
    explicit = rollout(lambda k, s: rk4_step(closed_loop(dynamics, loop), torch.tensor(0.0), s, dt), x[:1], 100)
    assert explicit.diverged_at[0] >= 0


def closed_loop(dynamics: SoftArmDynamics, loop):  # type: ignore[no-untyped-def]
    def call(t: Tensor, x: Tensor) -> Tensor:
        now = ArmState(*x.chunk(2, dim=-1))
        return torch.cat((now.qdot, dynamics(now.q, now.qdot, loop(now).tau)), dim=-1)

    return call


def test_guard() -> None:
    before = torch.zeros(4, 2, dtype=D)
    proposed = torch.tensor([[1.0, 2.0], [torch.nan, 0.0], [0.0, torch.inf], [2e3, 0.0]], dtype=D)
    state, diverged_at = guard(before, proposed, torch.tensor([-1, -1, -1, -1]), 7)
    assert diverged_at.tolist() == [-1, 7, 7, 7]
    assert torch.equal(state, torch.cat((proposed[:1], before[1:])))
    # Once frozen, frozen for good.
    state, diverged_at = guard(state, torch.ones(4, 2, dtype=D), diverged_at, 8)
    assert diverged_at.tolist() == [-1, 7, 7, 7] and torch.equal(state[1:], before[1:])


def test_a_diverging_row_leaves_its_neighbours_alone() -> None:
    dynamics = arm(2)

    def step(k: int, x: Tensor) -> Tensor:
        now = ArmState(*x.chunk(2, dim=-1))
        return torch.cat(semi_implicit_step(dynamics, now, Actuation(torch.zeros_like(now.q)), 5e-3), dim=-1)

    x = start(6, (5,))
    bad = x.clone()
    bad[3, 6:] = 900.0
    good_run, bad_run = rollout(step, x, 30), rollout(step, bad, 30)
    others = [0, 1, 2, 4]
    assert torch.equal(bits(good_run.state[:, others]), bits(bad_run.state[:, others]))
    assert bad_run.diverged_at[others].tolist() == [-1] * 4 and bad_run.diverged_at[3] >= 0
    assert bool(bad_run.state.isfinite().all())
    frozen = int(bad_run.diverged_at[3])
    assert torch.equal(bad_run.state[frozen, 3], bad_run.state[-1, 3])


def test_gradient_through_a_rollout() -> None:
    dynamics = arm(1)

    def final(x: Tensor, tau: Tensor) -> Tensor:
        def step(k: int, s: Tensor) -> Tensor:
            now = ArmState(*s.chunk(2, dim=-1))
            return torch.cat(semi_implicit_step(dynamics, now, Actuation(tau), 5e-3), dim=-1)

        return rollout(step, x, 5).state[-1]

    check_gradients(final, start(3), 0.05 * torch.ones(3, dtype=D), second=False)
