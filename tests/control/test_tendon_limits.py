"""The program under tendon limits against scipy's constrained minimisers and against Eq. (16) without limits."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from scipy.optimize import LinearConstraint, lsq_linear, minimize
from torch import Tensor

from apcc_torch.control import tendon_limits as module
from apcc_torch.control.inverse_kinematics import InverseKinematics
from apcc_torch.control.task_stack import TaskStack
from apcc_torch.control.tasks import Task, TaskRate, TaskTarget
from apcc_torch.control.tendon_limits import ConstrainedVelocity, SolverStatus, TendonLimits
from apcc_torch.errors import ConfigError, ShapeError, ValueRangeError
from apcc_torch.model.backbone import PCCBackbone
from apcc_torch.model.tendons import rack_routing
from arms import HANGING_BASE, PI, configurations
from laws import generator, normal, seeds

pytest.importorskip("daqp")
BACKBONE = PCCBackbone(3, HANGING_BASE)
B = rack_routing(torch.tensor([0.105, 0.36, 0.60], dtype=torch.float64)).matrix(PI)
INF = torch.full((9,), torch.inf, dtype=torch.float64)


def asked(J: Tensor, v: Tensor, weight: float = 1.0) -> list[TaskRate]:
    return [TaskRate(J, v, torch.zeros_like(v), torch.full_like(v, weight))]


def problem(seed: int, rows: int = 1) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """J (rows, 3, 9), the wanted velocity (rows, 3), q (rows, 9) and a descent (rows, 9)."""
    rng = generator(seed)
    q = configurations((rows,), 3, torch.float64, rng)
    v, descent = 0.3 * normal((rows, 3), torch.float64, rng), 0.05 * normal((rows, 9), torch.float64, rng)
    return BACKBONE.tip_jacobian(q, PI), v, q, descent


def test_without_limits_it_is_the_inverse_kinematics() -> None:
    J, v, q, _ = problem(1, rows=50)
    solver = InverseKinematics(K=1.0, damping=1e-2, null_gain=0.05)
    qdot, status = ConstrainedVelocity(1e-2)(asked(J, v), B, -INF, INF, solver.descent(q))
    torch.testing.assert_close(qdot, solver(J, torch.zeros_like(v), v, q), rtol=0, atol=1e-9)
    assert bool((status == SolverStatus.FREE).all())


@given(seed=seeds)
@settings(max_examples=20, deadline=None)
def test_limits_give_the_constrained_minimum(seed: int) -> None:
    J, v, _, descent = problem(seed)
    bound = torch.full((9,), 0.01, dtype=torch.float64)
    damping = 0.05
    qdot, status = ConstrainedVelocity(damping)(asked(J, v, 2.0), B, -bound, bound, descent)
    speed = (B.mT @ qdot.unsqueeze(-1)).squeeze(-1)
    assert float(speed.abs().max()) <= 0.01 + 1e-9
    # With z = B^T qdot, B being invertible, the limits are a box on z, and the cost a linear least squares in z.
    back = np.linalg.inv(B.mT.numpy())
    rows = np.concatenate([2.0 * J[0].numpy(), damping * np.eye(9)]) @ back
    wanted = np.concatenate([2.0 * v[0].numpy(), damping * descent[0].numpy()])
    z = speed[0].numpy()
    high, low = z > 0.01 - 1e-8, z < -0.01 + 1e-8
    # In a convex program these signs of the slope prove the minimum: none inside, outwards at the bounds.
    slope = rows.T @ (rows @ z - wanted)
    least = 1e-6 * np.abs(rows).max() * np.abs(wanted).max()
    assert np.abs(slope[~high & ~low]).max(initial=0.0) < least
    assert slope[high].max(initial=0.0) < least and slope[low].min(initial=0.0) > -least
    assert int(status) == (SolverStatus.LIMITED if (high | low).any() else SolverStatus.FREE)
    best = lsq_linear(rows, wanted, (-0.01, 0.01), tol=1e-14, method="bvls")
    assert np.square(rows @ z - wanted).sum() <= 2.0 * best.cost * (1 + 1e-6) + 1e-12


def test_the_error_that_is_left_is_what_the_limits_allow() -> None:
    # A goal out of reach under the limits: the loop ends where a minimiser over all shapes under them ends.
    x_d = torch.tensor([0.16, 0.08, -0.50], dtype=torch.float64)
    bound = torch.full((9,), 0.004, dtype=torch.float64)
    limits, program = TendonLimits(-bound, bound), ConstrainedVelocity(1e-2)
    stack, q, dt = TaskStack([Task(gain=2.0)]), torch.zeros(9, dtype=torch.float64), torch.tensor(0.05)
    for _ in range(300):
        rates = stack.rates(BACKBONE, q, PI, [TaskTarget(x_d)])
        q = q + 0.05 * program(rates, B, *limits.rates(B.mT @ q, dt.double())).qdot
    assert float((B.mT @ q).abs().max()) <= 0.004 + 1e-9

    def distance(x: np.ndarray) -> float:
        return float((BACKBONE.tip(torch.from_numpy(x), PI) - x_d).square().sum()) * 1e2

    best = minimize(distance, np.zeros(9), method="SLSQP", constraints=[LinearConstraint(B.mT.numpy(), -0.004, 0.004)])
    left = float((BACKBONE.tip(q, PI) - x_d).norm())
    assert left > 0.02
    assert left == pytest.approx((best.fun / 1e2) ** 0.5, abs=5e-4)


def test_more_tendons_than_coordinates() -> None:
    rng = generator(3)
    J, v, _, descent = problem(3)
    A = normal((9, 14), torch.float64, rng) * 0.1
    lower, upper = torch.full((14,), -0.02).double(), torch.full((14,), 0.01).double()
    qdot, _ = ConstrainedVelocity(0.05)(asked(J, v), A, lower, upper, descent)
    Jn, vn, dn, An = J[0].numpy(), v[0].numpy(), descent[0].numpy(), A.mT.numpy()

    def cost(x: np.ndarray) -> float:
        return float(np.square(Jn @ x - vn).sum() + 0.05**2 * np.square(x - dn).sum())

    best = minimize(
        cost, np.zeros(9), method="SLSQP", constraints=[LinearConstraint(An, -0.02, 0.01)], options={"ftol": 1e-15}
    )
    assert cost(qdot[0].numpy()) <= best.fun + 1e-9
    assert float((A.mT @ qdot[0]).max()) <= 0.01 + 1e-9


def test_contradicting_limits_are_named_and_nearly_met() -> None:
    J, v, _, _ = problem(4, rows=3)
    # Two tendons on one line, one asked to lengthen and the other to shorten; rows 0 and 2 have no such demand.
    A = torch.cat((B, B[:, :1]), dim=-1)
    lower, upper = torch.full((3, 10), -1.0).double(), torch.full((3, 10), 1.0).double()
    lower[1, 0], upper[1, 9] = 0.02, -0.04
    qdot, status = ConstrainedVelocity(1e-2)(asked(J, v), A, lower, upper)
    assert status.tolist() == [SolverStatus.FREE, SolverStatus.INFEASIBLE, SolverStatus.FREE]
    # Least squares of the two violations meets in the middle.
    assert float(A[:, 0] @ qdot[1]) == pytest.approx(-0.01, abs=1e-5)
    crossed, status = ConstrainedVelocity(1e-2)(asked(J[:1], v[:1]), B, upper[:1, :9], lower[:1, :9])
    assert int(status) == SolverStatus.INFEASIBLE and bool(torch.isfinite(crossed).all())


def test_a_row_that_is_not_finite_stands_still() -> None:
    J, v, _, _ = problem(5, rows=2)
    v[0, 0] = torch.nan
    qdot, status = ConstrainedVelocity()(asked(J, v), B, -INF, INF)
    assert status.tolist() == [SolverStatus.NOT_FINITE, SolverStatus.FREE]
    assert float(qdot[0].abs().max()) == 0.0
    torch.testing.assert_close(J[1] @ qdot[1], v[1], rtol=0, atol=1e-3)


def test_limits_of_length_and_speed() -> None:
    low, high, rate = (torch.full((2,), v, dtype=torch.float64) for v in (-0.03, 0.02, 0.1))
    y, dt = torch.tensor([0.019, 0.05], dtype=torch.float64), torch.tensor(0.1, dtype=torch.float64)
    slowest, fastest = TendonLimits(low, high).rates(y, dt)
    torch.testing.assert_close(y + dt * fastest, high)
    torch.testing.assert_close(y + dt * slowest, low)
    slowest, fastest = TendonLimits(low, high, rate).rates(y, dt)
    torch.testing.assert_close(fastest, torch.tensor([0.01, -0.1], dtype=torch.float64))
    # A tendon that is outside comes back at its rate, and no bound crosses another.
    torch.testing.assert_close(slowest, torch.tensor([-0.1, -0.1], dtype=torch.float64))
    assert bool((slowest <= fastest).all())


def test_refusals(monkeypatch: pytest.MonkeyPatch) -> None:
    zero, one = torch.zeros(2), torch.ones(2)
    with pytest.raises(ValueRangeError, match="lower must be below upper"):
        TendonLimits(one, zero)
    with pytest.raises(ValueRangeError, match="rate must be positive"):
        TendonLimits(zero, one, zero)
    with pytest.raises(ShapeError, match="upper must have shape"):
        TendonLimits(zero, torch.ones(3))
    with pytest.raises(ValueRangeError, match="damping must be positive"):
        ConstrainedVelocity(0.0)
    J, v, _, _ = problem(6)
    with pytest.raises(ShapeError, match="B must have shape"):
        ConstrainedVelocity()(asked(J, v), B[:6], -INF, INF)
    monkeypatch.setattr(module, "daqp", None)
    with pytest.raises(ConfigError, match=r"needs daqp: pip install 'apcc-torch\[qp\]'"):
        ConstrainedVelocity()
