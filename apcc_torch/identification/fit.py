"""Nonlinear least squares with a belief before the fit: Levenberg-Marquardt over standard scores, and what it knows."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import torch
from torch import Tensor
from torch.func import vmap

from apcc_torch.errors import DataError
from apcc_torch.identification.left_out import Margins, left_out, leverage, margins, movements_of
from apcc_torch.identification.parameters import Parameters, Values
from apcc_torch.identification.tendon_arm import Drive, TendonArm
from apcc_torch.settings import MANY, OURS, Settings, setting

_ROBUST = 3.0
"""Residuals beyond so many times their size are weighed down (Huber)."""
_STEP = 1e-6
"""Step of the differences, in standard scores."""


@dataclass(frozen=True, kw_only=True)
class FitSettings(Settings):
    """How parameters are fitted."""

    steps: int = setting(25, "", OURS, "most steps a round", least=1, most=MANY)
    rounds: int = setting(3, "", OURS, "how often the size of the residuals is estimated", least=1, most=MANY)


class Fit(NamedTuple):
    """The most probable parameters and what the data say about them.

    z: (P,) standard scores.
    information: (P, P) of the data alone, in z, if residuals were independent noise; the belief before the fit adds
        the identity.
    noise: Root of the mean square of one coordinate's residual, m.
    correlation: Number of neighbouring samples that are worth one independent sample.
    steps: Steps taken.
    movements: Number of movements that were left out in turn, to learn the next two.
    covariance: (P, P) of z after the fit, whatever the residuals are.
    margins: Of predictions.
    """

    z: Tensor
    information: Tensor
    noise: float
    correlation: float
    steps: int
    movements: int
    covariance: Tensor
    margins: Margins

    @property
    def posterior(self) -> Tensor:
        """Covariance (P, P) that z would have if residuals were independent noise."""
        return _posterior(self.information)


def _posterior(information: Tensor) -> Tensor:
    return torch.linalg.inv(information + torch.eye(len(information), dtype=information.dtype))


def correlation_length(residual: Tensor) -> float:
    """Number of samples in a row that are worth one independent sample: 1 + 2 sum of autocorrelations, at least 1.

    The sum ends where the autocorrelation first falls below zero (Geyer's rule in its simplest form).

    Args:
        residual: (N, d) in the order of time.
    """
    centred = residual - residual.mean(0)
    power = float((centred * centred).sum())
    total = 1.0
    for lag in range(1, len(residual) // 2):
        rho = float((centred[lag:] * centred[:-lag]).sum()) / power if power > 0 else 0.0
        if rho <= 2.0 / math.sqrt(residual.numel()):
            break
        total += 2.0 * rho
    return total


def fit(
    arm: TendonArm,
    parameters: Parameters,
    drive: Drive,
    positions: Tensor,
    settings: FitSettings | None = None,
    z: Tensor | None = None,
    progress: Callable[[str], None] | None = None,
    groups: Tensor | None = None,
) -> Fit:
    """Fits an arm's parameters to measured positions.

    Maximizes the posterior: residuals weigh as independent normal noise of the size that they turn out to have, less
    what neighbouring samples repeat; a few outliers are weighed down. The size is estimated anew in every round.

    Args:
        arm: The model.
        parameters: What to fit.
        drive: What drove the arm at N moments, in the order of time.
        positions: (N, k, 3) where its bodies were, m.
        settings: See `FitSettings`; None: the defaults.
        z: (P,) where to begin; None: nominal values.
        progress: Called with one line a round.
        groups: (N,) int64 number of each sample's movement, as far as the recording tells; see `movements_of`.

    Raises:
        DataError: The model has no equilibrium where it begins.
    """
    settings = settings or FitSettings()
    z = parameters.nominal() if z is None else z
    problem = _Problem(arm, parameters, drive, positions)
    residual, _ = problem.residual(z)
    if not bool(residual.isfinite().all()):
        raise DataError("the model finds no equilibrium at its first parameters; check tendons and stiffness")
    noise, correlation, taken = _size(residual), correlation_length(residual.flatten(1)), 0
    for k in range(settings.rounds):
        z, count = _descend(problem, z, noise * math.sqrt(correlation), settings.steps)
        residual, _ = problem.residual(z)
        noise, correlation, taken = _size(residual), correlation_length(residual.flatten(1)), taken + count
        if progress is not None:
            progress(f"round {k + 1}: {1e3 * noise * math.sqrt(3.0):.3g} mm after {count} steps")
    size, N = noise * math.sqrt(correlation), len(positions)
    J, weight, residual = problem.jacobian(z)
    rows, weight = J.unflatten(0, (N, -1)), weight.unflatten(0, (N, -1))
    told = J.mT @ (weight.flatten().unsqueeze(-1) * J) / size**2
    movement = movements_of(groups, N)
    without = left_out(rows, weight, residual.flatten(1), size, movement)
    posterior = _posterior(told)
    off, spread = (v.view_as(residual) for v in (without.error, leverage(rows, posterior)))
    covariance = without.covariance(posterior)
    return Fit(z, told, noise, correlation, taken, len(without.steps), covariance, margins(off, spread))


def information(
    arm: TendonArm, parameters: Parameters, drive: Drive, positions: Tensor, z: Tensor, size: float
) -> Tensor:
    """What measured positions say of the parameters at z (P, P), as `Fit.information`.

    Args:
        arm, parameters, drive, positions: See `fit`.
        z: (P,) standard scores.
        size: Of a coordinate's residual, m, with what neighbouring samples repeat.
    """
    J, weight, _ = _Problem(arm, parameters, drive, positions).jacobian(z)
    return J.mT @ (weight.unsqueeze(-1) * J) / size**2


def sensitivity(arm: TendonArm, parameters: Parameters, drive: Drive, z: Tensor, q: Tensor) -> Tensor:
    """Derivatives (N, k, 3, P) of the predicted positions by the scores z (P,), m, at the equilibria q (N, n).

    From differences, all at once: to some 1e-6, more than an interval needs, in a fraction of the time of forward
    derivatives, most of whose operations would meet tensors that do not depend on z.
    """
    with torch.no_grad():
        slope = arm.resting_slope(drive, parameters.values(z), q)
        steps = _STEP * torch.eye(len(z), dtype=z.dtype, device=z.device)

        def predicted(at: Tensor) -> Tensor:
            values: Values = parameters.values(at)
            return arm.positions(drive, values, q, slope)

        here, ahead = vmap(predicted)(torch.cat((z.unsqueeze(0), z + steps))).split((1, len(z)))
        return ((ahead - here) / _STEP).movedim(0, -1)


def _size(residual: Tensor) -> float:
    """Root of the mean square of a coordinate."""
    return float(residual.square().mean().sqrt())


class _Problem:
    """Residuals of a fit, their Jacobian, and the equilibria found so far."""

    def __init__(self, arm: TendonArm, parameters: Parameters, drive: Drive, positions: Tensor) -> None:
        self.arm, self.parameters, self.drive, self.measured = arm, parameters, drive, positions
        self.q: Tensor | None = None

    def residual(self, z: Tensor) -> tuple[Tensor, Tensor]:
        """Measured less predicted positions (N, k, 3), and the equilibria."""
        values = self.parameters.values(z)
        q = self.arm.rest(self.drive, values, self.q)
        return self.measured - self.arm.bodies(q, values), q

    def jacobian(self, z: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """d(predicted)/dz (3 k N, P), m, the robust weight of each row, and the residual (N, k, 3) there."""
        residual, q = self.residual(z)
        self.q = q
        J = sensitivity(self.arm, self.parameters, self.drive, z, q)
        return J.flatten(0, 2), _weights(residual).flatten(), residual


def _weights(residual: Tensor) -> Tensor:
    """Huber's weights (N, k, 3) by the length of each body's residual."""
    length = torch.linalg.vector_norm(residual, dim=-1, keepdim=True)
    limit = _ROBUST * length.square().mean().sqrt()
    return (limit / length.clamp(min=1e-300)).clamp(max=1.0).expand_as(residual)


def _descend(problem: _Problem, z: Tensor, size: float, steps: int) -> tuple[Tensor, int]:
    """Levenberg-Marquardt on half the squared residuals over size^2 and half the squared scores."""

    def cost(at: Tensor, residual: Tensor, weight: Tensor) -> float:
        value = 0.5 * float((weight * (residual.flatten() / size).square()).sum() + at.square().sum())
        return value if math.isfinite(value) else math.inf

    damping, taken = 1e-2, 0
    eye = torch.eye(len(z), dtype=z.dtype)
    while taken < steps:
        J, weight, residual = problem.jacobian(z)
        J = J / size
        H = J.mT @ (weight.unsqueeze(-1) * J) + eye
        gradient = J.mT @ (weight * residual.flatten() / size) - z
        now = cost(z, residual, weight)
        for _ in range(12):
            step = torch.linalg.solve(H + damping * torch.diag(H.diagonal()), gradient)
            there = cost(z + step, problem.residual(z + step)[0], weight)
            if there < now:
                break
            damping *= 5.0
        else:
            return z, taken
        z, damping, taken = z + step, max(0.2 * damping, 1e-9), taken + 1
        if now - there < 1e-4 * now:
            break
    return z, taken
