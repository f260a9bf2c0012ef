"""Equilibria of an arm under generalized forces, tendon tensions or prescribed tendon lengths."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from apcc_torch.errors import ConfigError
from apcc_torch.model.arm_dynamics import ArmDynamics
from apcc_torch.model.loads import Loads, Payload
from apcc_torch.model.tendons import TendonRouting
from apcc_torch.modes import full_precision, none_left
from apcc_torch.shapes import batch_shape, check_tensor

NO_LOADS = Loads()


class Equilibrium(NamedTuple):
    """A shape at rest.

    q: (..., n) rad, rad, m.
    u: (..., n_a) forces conjugate to tendon length, N (tension is -u); None without tendons.
    residual: (...) norm of the unbalanced force in the elastic metric, sqrt(r^T K^-1 r), sqrt(J).
    converged: (...) bool: the forces are balanced, and no section is of no length or turned inside out.
    iterations: (...) int64 steps each row took.
    """

    q: Tensor
    u: Tensor | None
    residual: Tensor
    converged: Tensor
    iterations: Tensor


class _Problem(NamedTuple):
    dynamics: ArmDynamics
    payload: Payload
    loads: Loads
    tau: Tensor
    matrix: Tensor | None
    target: Tensor | None
    compliance: float


def load_stiffness(
    dynamics: ArmDynamics,
    q: Tensor,
    payload: Payload = None,
    loads: Loads = NO_LOADS,
) -> tuple[Tensor, Tensor]:
    """`static_load` (..., n) and its derivative by q (..., n, n); carries no gradient.

    Args:
        dynamics: The arm.
        q: (..., n) rad, rad, m.
        payload: (...) tip mass, kg.
        loads: External loads.

    Example:
        >>> load, slope = load_stiffness(Arm(lengths=[0.2, 0.25]).dynamics(), torch.zeros(6).double())
        >>> load[[2, 5]], slope.shape
        (tensor([-7.6300, -2.7250], dtype=torch.float64), torch.Size([6, 6]))
    """
    n = q.shape[-1]
    with torch.enable_grad():
        # One evaluation of n copies: copy i is asked for the gradient of component i.
        copies = q.detach().repeat(n, *[1] * q.dim()).requires_grad_()
        load = dynamics.static_load(copies, payload, *loads)
        (rows,) = torch.autograd.grad(load.diagonal(dim1=0, dim2=-1).sum(), copies)
    return load[0].detach(), rows.movedim(0, -2)


@full_precision
def equilibrium(
    dynamics: ArmDynamics,
    tau: Tensor | None = None,
    *,
    routing: TendonRouting | None = None,
    tensions: Tensor | None = None,
    tendon_lengths: Tensor | None = None,
    compliance: float = 0.0,
    payload: Payload = None,
    loads: Loads = NO_LOADS,
    q: Tensor | None = None,
    iterations: int = 100,
    tolerance: float = 1e-10,
) -> Equilibrium:
    """Solves K q + G(q) = tau + B u + external loads, row by row, by Newton's method with a Levenberg safeguard.

    Either the tensions are given, or the tendon lengths are: then u is what holds B^T q + compliance u at them. The
    result is differentiable in the loads and the arm's parameters (its last step carries the implicit derivative).

    Args:
        dynamics: The arm.
        tau: (..., n) generalized force; None is zero.
        routing: The tendons, when `tensions` or `tendon_lengths` is given.
        tensions: (..., n_a) pulling forces, N; u = -tensions.
        tendon_lengths: (..., n_a) prescribed length changes y, m.
        compliance: Stretch of every tendon per force, m/N; zero is inextensible.
        payload: (...) tip mass, kg.
        loads: External loads.
        q: (..., n) first guess; None is the straight arm.
        iterations: Most steps tried.
        tolerance: Converged when sqrt(r^T K^-1 r) is below tolerance * max(1, sqrt(q^T K q)), sqrt(J).

    Raises:
        ConfigError: Tensions and lengths are both given, or the routing is missing.

    Example:
        >>> arm = Arm(lengths=[0.2, 0.25], mass=0.4)
        >>> pulls = torch.tensor([0.0, 0.0, 0.0, 2.0, 0.0, 0.0]).double()
        >>> rest = equilibrium(arm.dynamics(), routing=arm.routing(), tensions=pulls)
        >>> arm.backbone().tip(rest.q, arm.rest_lengths())
        tensor([ 0.0288, -0.0166, -0.4462], dtype=torch.float64)
    """
    if tensions is not None and tendon_lengths is not None:
        raise ConfigError("give tensions or tendon_lengths, not both")
    given = tensions if tensions is not None else tendon_lengths
    if given is not None and routing is None:
        raise ConfigError("routing is needed with tensions or tendon_lengths")
    n, n_b = dynamics.n, dynamics.n_sections
    parts = {"tau": tau, "q": q, "given": given}
    shapes = {name: (value, 1) for name, value in parts.items() if value is not None} | loads.checked(n_b)
    if isinstance(payload, Tensor):
        shapes["payload"] = (payload, 0)
    batch = batch_shape(parameters=(dynamics.batch_marker, 0), **shapes)
    zeros = torch.zeros(*batch, n, dtype=dynamics.lengths.dtype, device=dynamics.lengths.device)
    force = zeros if tau is None else check_tensor("tau", tau, (n,)).expand(*batch, n)
    matrix = None
    u = None
    if routing is not None and given is not None:
        check_tensor("tensions" if tensions is not None else "tendon_lengths", given, (routing.n_tendons,))
        matrix = dynamics.kinematics().tendon_matrix(routing, dynamics.lengths)
        u = torch.zeros(*batch, routing.n_tendons, dtype=zeros.dtype, device=zeros.device)
        if tensions is not None:
            u = u - tensions
            force = force + (matrix @ u.unsqueeze(-1)).squeeze(-1)
            matrix = None
    target = tendon_lengths
    problem = _Problem(dynamics, payload, loads, force, matrix, target, compliance)
    start = zeros if q is None else check_tensor("q", q, (n,)).expand(*batch, n)
    constrained = matrix is not None and u is not None
    unknown = torch.cat((start, u), dim=-1) if constrained and u is not None else start
    with torch.no_grad():
        solved, residual, balanced, taken = _newton(problem, unknown, n, iterations, tolerance)
        _, jacobian = _balance(problem, solved, n)
        lengths = dynamics.lengths + solved[..., n // n_b - 1 : n : n // n_b]  # a section's last coordinate
    if torch.is_grad_enabled():
        # At a root this step is zero; its derivative is that of the implicit function.
        step = torch.linalg.solve_ex(jacobian, _residual(problem, solved, n).unsqueeze(-1))[0].squeeze(-1)
        solved = solved - torch.where(balanced.unsqueeze(-1), step, 0.0)
    if constrained:
        u = solved[..., n:]
    return Equilibrium(solved[..., :n], u, residual, balanced & (lengths > 0.0).all(-1), taken)


def _residual(problem: _Problem, unknown: Tensor, n: int, load: Tensor | None = None) -> Tensor:
    """Unbalanced force (..., n) and, with prescribed tendon lengths, what they miss (..., n_a)."""
    q = unknown[..., :n]
    if load is None:
        load = problem.dynamics.static_load(q, problem.payload, *problem.loads)
    residual = problem.dynamics.stiffness_diagonal * q + load - problem.tau
    if problem.matrix is None or problem.target is None:
        return residual
    u, matrix = unknown[..., n:], problem.matrix
    residual = residual - (matrix @ u.unsqueeze(-1)).squeeze(-1)
    stretch = (matrix.mT @ q.unsqueeze(-1)).squeeze(-1) + problem.compliance * u - problem.target
    return torch.cat((residual, stretch), dim=-1)


def _balance(problem: _Problem, unknown: Tensor, n: int) -> tuple[Tensor, Tensor]:
    """`_residual` and its Jacobian."""
    load, slope = load_stiffness(problem.dynamics, unknown[..., :n], problem.payload, problem.loads)
    residual = _residual(problem, unknown, n, load)
    jacobian = problem.dynamics.stiffness + slope
    matrix = problem.matrix
    if matrix is None or problem.target is None:
        return residual, jacobian
    eye = problem.compliance * torch.eye(matrix.shape[-1], dtype=matrix.dtype, device=matrix.device)
    wide = matrix.expand(*jacobian.shape[:-2], *matrix.shape[-2:])
    top = torch.cat((jacobian, -wide), dim=-1)
    bottom = torch.cat((wide.mT, eye.expand(*wide.shape[:-2], *eye.shape)), dim=-1)
    return residual, torch.cat((top, bottom), dim=-2)


def _newton(
    problem: _Problem, unknown: Tensor, n: int, iterations: int, tolerance: float
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Damped Newton: the elastic stiffness is added, times a factor of each row, while steps do not help."""
    stiffness = problem.dynamics.stiffness_diagonal
    # Of each section the bends come first, and the elongation last.
    period = n // problem.dynamics.n_sections
    axial = stiffness[..., period - 1 :: period].mean(-1, keepdim=True)
    constraints = unknown.shape[-1] - n
    # Force residuals are weighed by K^-1 and length residuals by a stiffness, so that both are energies.
    weight = torch.cat((1.0 / stiffness, axial.expand(*axial.shape[:-1], constraints)), dim=-1)
    extra = torch.cat((stiffness, torch.zeros_like(stiffness[..., :1]).expand(*stiffness.shape[:-1], constraints)), -1)

    def size(residual: Tensor) -> Tensor:
        return torch.sqrt((weight * residual * residual).sum(-1))

    residual, jacobian = _balance(problem, unknown, n)
    merit = size(residual)
    damping = torch.zeros_like(merit)
    taken = torch.zeros(merit.shape, dtype=torch.int64, device=merit.device)
    for _ in range(iterations):
        elastic = torch.sqrt((stiffness * unknown[..., :n] ** 2).sum(-1))
        running = ~(merit <= tolerance * elastic.clamp(min=1.0)) & torch.isfinite(merit)
        if none_left(running):
            break
        system = jacobian + torch.diag_embed(damping.unsqueeze(-1) * extra)
        step, _info = torch.linalg.solve_ex(system, -residual.unsqueeze(-1))
        step = step.squeeze(-1)
        # No section turns by more than half a radian in one step.
        largest = step[..., :n].unflatten(-1, (-1, period))[..., :2].abs().amax((-2, -1))
        step = step * (0.5 / largest.clamp(min=0.5)).unsqueeze(-1)
        trial = unknown + torch.where(running.unsqueeze(-1), step, 0.0)
        trial_residual, trial_jacobian = _balance(problem, trial, n)
        trial_merit = size(trial_residual)
        accept = running & (trial_merit < merit)
        wide = accept.unsqueeze(-1)
        unknown, residual = torch.where(wide, trial, unknown), torch.where(wide, trial_residual, residual)
        jacobian = torch.where(wide.unsqueeze(-1), trial_jacobian, jacobian)
        merit = torch.where(accept, trial_merit, merit)
        # Rejected: more damping. Accepted: less, down to none.
        damping = torch.where(accept, torch.where(damping > 1e-3, 0.2 * damping, 0.0), (4.0 * damping).clamp(min=1e-2))
        taken = taken + running
    elastic = torch.sqrt((stiffness * unknown[..., :n] ** 2).sum(-1))
    return unknown, merit, merit <= tolerance * elastic.clamp(min=1.0), taken
