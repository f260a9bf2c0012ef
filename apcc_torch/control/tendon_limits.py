"""Tasks under limits of the tendons: a small quadratic program for every row.

    min  |W (J qdot - v)|^2 + damping^2 |qdot - descent|^2
    s.t. lower <= y + dt B^T qdot <= upper,   |B^T qdot| <= rate.

Without the limits its solution is Eq. (16) with the damped pseudo-inverse, to the last term. A limit changes which
velocity is best, where cutting a finished command would spoil the direction of the task. DAQP solves it: a dual
active-set method in C, exact to rounding, without dependencies, and made for problems of this size.
"""

from __future__ import annotations

from collections.abc import Sequence
from enum import IntEnum
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from apcc_torch.control.tasks import TaskRate, weighted_rows
from apcc_torch.errors import ConfigError, ValueRangeError
from apcc_torch.modes import holds
from apcc_torch.part import Part, hold_numbers, hold_rows, refuse_parameter
from apcc_torch.settings import Setting, aligned, check_setting
from apcc_torch.shapes import batch_shape, check_tensor

try:
    import daqp
except ImportError:  # an extra; `ConstrainedVelocity` says so when it is made
    daqp = None

Array = NDArray[np.float64]

SOFT = 8
"""DAQP's mark of a constraint that may be violated at a cost."""
ROUNDING = 1e-9
"""How far a solution may be over a bound, m/s."""


class SolverStatus(IntEnum):
    """What a row's solution is.

    FREE: No limit mattered. LIMITED: The best within the limits. INFEASIBLE: The limits contradict each other, and this
    velocity violates them least. NOT_FINITE: The row's problem is not finite; its velocity is zero.
    """

    FREE = 0
    LIMITED = 1
    INFEASIBLE = 2
    NOT_FINITE = 3


class TendonLimits(Part):
    """What tendons may do. Each is a number for all or (..., n_a).

    Args:
        lower: (..., n_a) smallest length change y, m.
        upper: (..., n_a) largest, m.
        rate: (..., n_a) largest speed, m/s; None for no limit.

    Raises:
        ValueRangeError: lower is not below upper, or the rate is not positive.
    """

    lower: Tensor
    upper: Tensor
    rate: Tensor | None

    def __init__(self, lower: Tensor, upper: Tensor, rate: Tensor | None = None) -> None:
        super().__init__()
        check_tensor("lower", lower, (None,))
        check_tensor("upper", upper, (lower.shape[-1],))
        if not holds(lower < upper):
            raise ValueRangeError("lower must be below upper for every tendon")
        if rate is not None:
            check_tensor("rate", rate, (lower.shape[-1],))
            if not holds(rate > 0):
                raise ValueRangeError("rate must be positive for every tendon")
        hold_rows(self, lower=(lower, 1), upper=(upper, 1), rate=(rate, 1))

    def rates(self, y: Tensor, dt: Tensor) -> tuple[Tensor, Tensor]:
        """Bounds (..., n_a), m/s, on the tendons' speeds that keep lengths y (..., n_a) in the limits for dt (...).

        A tendon that is outside is asked back, as fast as its rate allows.
        """
        step = dt.unsqueeze(-1).clamp(min=1e-6)
        slowest, fastest = (self.lower.to(y) - y) / step, (self.upper.to(y) - y) / step
        if self.rate is None:
            return slowest, fastest
        rate = self.rate.to(y)
        return torch.clamp(slowest, -rate, rate), torch.clamp(fastest, -rate, rate)

    def held(self, y: Tensor) -> Tensor:
        """y (..., n_a) cut to the limits of length."""
        return torch.clamp(y, self.lower.to(y), self.upper.to(y))


class Constrained(NamedTuple):
    """qdot (..., n), and the status (...) of every row, a `SolverStatus`."""

    qdot: Tensor
    status: Tensor


class ConstrainedVelocity(Part):
    """Solves the program of the module's head, row by row on the CPU.

    It costs some tens of microseconds a row, has no gradient and cannot be compiled: it is meant for one arm, or a few.
    Large batches use `TaskStack` with `RateBounds`, which is batched and holds bounds on coordinates.

    Args:
        damping: As in `InverseKinematics`, m per rad; positive, for it makes the program strictly convex.

    Raises:
        ConfigError: daqp is not installed.
        ValueRangeError: damping is not positive.
    """

    damping: Setting

    def __init__(self, damping: Setting = 1e-3) -> None:
        super().__init__()
        if daqp is None:
            raise ConfigError("ConstrainedVelocity needs daqp: pip install 'apcc-torch[qp]'")
        refuse_parameter("damping", damping, "the program has no gradient; hand in a number")
        hold_numbers(self, damping=check_setting("damping", damping))

    def forward(
        self,
        rates: Sequence[TaskRate],
        B: Tensor,
        lower: Tensor,
        upper: Tensor,
        descent: Tensor | None = None,
    ) -> Constrained:
        """The best velocity in lower <= B^T qdot <= upper.

        Args:
            rates: What the tasks ask for; all count in one sum, by their weights.
            B: (..., n, n_a), from `TendonRouting.matrix`, or any other n_a linear forms of qdot.
            lower: (..., n_a), from `TendonLimits.rates`, m/s.
            upper: (..., n_a) m/s.
            descent: (..., n) velocity to follow where no task forbids it; None for zero.

        Raises:
            ShapeError: The arguments do not fit each other.
        """
        J, v = weighted_rows(rates)
        n = J.shape[-1]
        check_tensor("B", B, (n, None))
        check_tensor("lower", lower, (B.shape[-1],))
        check_tensor("upper", upper, (B.shape[-1],))
        descent = torch.zeros_like(J[..., 0, :]) if descent is None else check_tensor("descent", descent, (n,))
        batch = batch_shape(J=(J, 2), v=(v, 2), B=(B, 2), lower=(lower, 1), upper=(upper, 1), descent=(descent, 1))
        squared = aligned(self.damping, 2) ** 2
        H = J.mT @ J + squared * torch.eye(n, dtype=J.dtype, device=J.device)
        f = -(J.mT @ v) - squared * descent.unsqueeze(-1)
        H, A = (value.expand(*batch, *value.shape[-2:]) for value in (H, B.mT))
        f = f.squeeze(-1).expand(*batch, n)
        bounds = (value.expand(*batch, B.shape[-1]) for value in (lower, upper))
        parts = [_rows(value, batch) for value in (H, f, A, *bounds)]
        solved = [_solve(*row) for row in zip(*parts, strict=True)]
        qdot = torch.tensor(np.array([x for x, _ in solved])).to(J).reshape(*batch, n)
        status = torch.tensor([int(s) for _, s in solved], dtype=torch.int64, device=J.device).reshape(batch)
        return Constrained(qdot, status)


def _rows(value: Tensor, batch: torch.Size) -> Array:
    """The value with its batch flattened to one leading dimension."""
    flat = value.detach().to("cpu", torch.float64).reshape(batch.numel(), *value.shape[len(batch) :])
    return np.ascontiguousarray(flat.numpy())


def _solve(H: Array, f: Array, A: Array, lower: Array, upper: Array) -> tuple[Array, SolverStatus]:
    """One row: min x'Hx / 2 + f'x in lower <= A x <= upper."""
    if not all(np.isfinite(part).all() for part in (H, f, A)) or np.isnan(lower).any() or np.isnan(upper).any():
        return np.zeros_like(f), SolverStatus.NOT_FINITE
    if (lower <= upper).all():
        x, ok = _minimum(H, f, A, lower, upper, 0)
        if ok:
            speed = A @ x
            at_bound = (speed > upper - ROUNDING) | (speed < lower + ROUNDING)
            return x, SolverStatus.LIMITED if at_bound.any() else SolverStatus.FREE
    # The two of a crossed pair meet halfway; then all limits give way, at a cost that dwarfs the tasks'.
    crossed = lower > upper
    middle = 0.5 * (np.where(crossed, lower, 0.0) + np.where(crossed, upper, 0.0))
    lower, upper = np.where(crossed, middle, lower), np.where(crossed, middle, upper)
    x, ok = _minimum(H, f, A, lower, upper, SOFT)
    return (x if ok else np.zeros_like(f)), SolverStatus.INFEASIBLE


def _minimum(H: Array, f: Array, A: Array, lower: Array, upper: Array, sense: int) -> tuple[Array, bool]:
    """DAQP's minimiser, and whether it found one."""
    senses = np.full(len(lower), sense, dtype=np.int32)
    settings: dict[str, Any] = {"primal_tol": 0.1 * ROUNDING, "rho_soft": 1e-8}
    x, _, flag, _ = daqp.solve(H, f, A, upper, lower, senses, **settings)
    return np.asarray(x, dtype=np.float64), flag > 0 and bool(np.isfinite(x).all())
