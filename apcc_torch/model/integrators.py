"""Time steps for batches of arms, explicit and linearly implicit, with a status for each row.

A row that stops being finite, or leaves a bound, is frozen at its last good state; its neighbours never notice.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import torch
from torch import Tensor

from apcc_torch.linalg import solve_spd
from apcc_torch.model.arm_dynamics import ArmDynamics
from apcc_torch.model.equation_of_motion import EquationOfMotion
from apcc_torch.model.loads import Payload
from apcc_torch.modes import full_precision

Field = Callable[[Tensor, Tensor], Tensor]


class ArmState(NamedTuple):
    """q (..., n) rad, rad, m and qdot (..., n) rad/s, rad/s, m/s.

    Example:
        >>> ArmState(q=torch.zeros(6), qdot=torch.zeros(6)).q.shape
        torch.Size([6])
    """

    q: Tensor
    qdot: Tensor


class Actuation(NamedTuple):
    """A generalized force at a state and its linearization there; caller-made, e.g. tendons under a PID loop.

    tau: (..., n).
    stiffness: (..., n, n) -dtau/dq, e.g. B Kp B^T. None: zero.
    damping: (..., n, n) -dtau/dqdot, e.g. B Kd B^T. None: zero.

    Example:
        >>> Actuation(tau=torch.zeros(6)).stiffness is None
        True
    """

    tau: Tensor
    stiffness: Tensor | None = None
    damping: Tensor | None = None


class Guarded(NamedTuple):
    """A state and when each row left it: diverged_at (...) int64, -1 while the row is good."""

    state: Tensor
    diverged_at: Tensor


def guard(previous: Tensor, proposed: Tensor, diverged_at: Tensor, step: int | Tensor, bound: float = 1e3) -> Guarded:
    """Accepts `proposed` for the rows that are finite, within `bound` and not diverged before; the others stay.

    Args:
        previous: (..., m) last good state.
        proposed: (..., m) next state.
        diverged_at: (...) int64, -1 for the rows that are good so far.
        step: Index of this step, recorded for the rows that diverge now.
        bound: Largest magnitude of any entry.
    """
    # NaN compares false, so this one comparison also finds what is not finite.
    good = (proposed.abs() <= bound).all(-1)
    running = diverged_at < 0
    state = torch.where((good & running).unsqueeze(-1), proposed, previous)
    return Guarded(state, torch.where(running & ~good, step, diverged_at))


def rk4_step(field: Field, t: Tensor, x: Tensor, dt: float | Tensor) -> Tensor:
    """One classical Runge-Kutta step of dx/dt = field(t, x), order 4.

    Args:
        field: (t, x) -> dx/dt.
        t: () or (...) time, s.
        x: (..., m) state.
        dt: Step, s.

    Example:
        >>> rk4_step(lambda t, x: -x, torch.tensor(0.0), torch.tensor([1.0, 2.0]), dt=0.1)
        tensor([0.9048, 1.8097])
    """
    half = 0.5 * dt
    k1 = field(t, x)
    k2 = field(t + half, x + half * k1)
    k3 = field(t + half, x + half * k2)
    k4 = field(t + dt, x + dt * k3)
    return x + (dt / 6.0) * (k1 + 2.0 * (k2 + k3) + k4)


def _residual_force(
    dynamics: ArmDynamics,
    diagonals: tuple[Tensor, Tensor],
    state: ArmState,
    tau: Tensor,
    payload: Payload,
    wrench: Tensor | None,
    equation: EquationOfMotion | None = None,
) -> tuple[Tensor, Tensor]:
    """M and the force tau - C qdot - G - D qdot - K q at a state, with the arm's `diagonals`."""
    if equation is None:
        equation = dynamics.equation(state.q, state.qdot, payload, wrench)
    K, D = diagonals
    return equation.inertia, tau - equation.bias - K * state.q - D * state.qdot


def _implicit_terms(diagonals: tuple[Tensor, Tensor], actuation: Actuation) -> tuple[Tensor, Tensor]:
    """Stiffness and damping (..., n, n) of the arm with its actuation."""
    stiffness, damping = (torch.diag_embed(each) for each in diagonals)
    if actuation.stiffness is not None:
        stiffness = stiffness + actuation.stiffness
    if actuation.damping is not None:
        damping = damping + actuation.damping
    return stiffness, damping


def _solve(matrix: Tensor, rhs: Tensor) -> Tensor:
    return solve_spd(matrix, rhs.unsqueeze(-1)).squeeze(-1)


@full_precision
def semi_implicit_step(
    dynamics: ArmDynamics,
    state: ArmState,
    actuation: Actuation,
    dt: float,
    payload: Payload = None,
    wrench: Tensor | None = None,
    equation: EquationOfMotion | None = None,
) -> ArmState:
    """Linearly implicit Euler in the stiff elastic, damping and actuation forces; order 1, one solve.

    (M + dt D + dt^2 K) (v+ - v) = dt (force(q, v) - dt K v),  q+ = q + dt v+, with K and D those of the arm and of
    the actuation together. Gravity and velocity forces are explicit.

    Args:
        dynamics: The arm.
        state: Current state.
        actuation: tau at the current state and its linearization.
        dt: Step, s.
        payload: (...) tip mass, kg.
        wrench: (..., 6) external tip wrench, world axes.
        equation: `dynamics.equation` at the current state with these loads, where it is known already.

    Example:
        >>> dynamics, still = Arm(lengths=[0.2, 0.25]).dynamics(), torch.zeros(6).double()
        >>> later = semi_implicit_step(dynamics, ArmState(still, still), Actuation(tau=still), dt=0.01)
        >>> later.qdot[[2, 5]]
        tensor([ 0.1025, -0.0054], dtype=torch.float64)
    """
    diagonals = dynamics.diagonals
    inertia, force = _residual_force(dynamics, diagonals, state, actuation.tau, payload, wrench, equation)
    stiffness, damping = _implicit_terms(diagonals, actuation)
    matrix = inertia + dt * damping + (dt * dt) * stiffness
    rhs = dt * (force - dt * (stiffness @ state.qdot.unsqueeze(-1)).squeeze(-1))
    qdot = state.qdot + _solve(matrix, rhs)
    return ArmState(state.q + dt * qdot, qdot)


@full_precision
def rosenbrock_step(
    dynamics: ArmDynamics,
    state: ArmState,
    actuate: Callable[[ArmState], Actuation],
    dt: float,
    payload: Payload = None,
    wrench: Tensor | None = None,
) -> ArmState:
    """The two-stage Rosenbrock-W method ROS2, order 2 whatever the linearization leaves out; L-stable in what it holds.

    k1 = (I - g dt A)^-1 dt f(x),  k2 = (I - g dt A)^-1 (dt f(x + k1) - 2 k1),  x+ = x + 3/2 k1 + 1/2 k2, with
    g = 1 - 1/sqrt(2) and A the elastic, damping and actuation part of df/dx at M(q) of the step's start. Where damping
    is large and M(q) changes much within a step, extrapolated `semi_implicit_step`s are the safer second order.

    Args:
        dynamics: The arm.
        state: Current state.
        actuate: state -> tau and its linearization; evaluated twice a step.
        dt: Step, s.
        payload: (...) tip mass, kg.
        wrench: (..., 6) external tip wrench, world axes.

    Example:
        >>> dynamics, still = Arm(lengths=[0.2, 0.25]).dynamics(), torch.zeros(6).double()
        >>> later = rosenbrock_step(dynamics, ArmState(still, still), lambda now: Actuation(tau=still), dt=0.01)
        >>> later.qdot[[2, 5]]
        tensor([ 0.1110, -0.0170], dtype=torch.float64)
    """
    g = (1.0 - 0.5**0.5) * dt
    actuation, diagonals = actuate(state), dynamics.diagonals
    inertia, force = _residual_force(dynamics, diagonals, state, actuation.tau, payload, wrench)
    stiffness, damping = _implicit_terms(diagonals, actuation)
    matrix = inertia + g * damping + (g * g) * stiffness

    def solve(rq: Tensor, momentum: Tensor) -> ArmState:
        """(kq, kv) of (I - g A)(kq, kv) = (rq, M^-1 momentum)."""
        kv = _solve(matrix, momentum - g * (stiffness @ rq.unsqueeze(-1)).squeeze(-1))
        return ArmState(rq + g * kv, kv)

    k1 = solve(dt * state.qdot, dt * force)
    middle = ArmState(state.q + k1.q, state.qdot + k1.qdot)
    later_inertia, later_force = _residual_force(dynamics, diagonals, middle, actuate(middle).tau, payload, wrench)
    change = dt * _solve(later_inertia, later_force) - 2.0 * k1.qdot
    k2 = solve(dt * middle.qdot - 2.0 * k1.q, (inertia @ change.unsqueeze(-1)).squeeze(-1))
    return ArmState(state.q + 1.5 * k1.q + 0.5 * k2.q, state.qdot + 1.5 * k1.qdot + 0.5 * k2.qdot)
