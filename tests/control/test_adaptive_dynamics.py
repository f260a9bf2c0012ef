"""The law of the dynamics in the case that its proof covers, against batch least squares, and at its edges."""

from __future__ import annotations

from typing import Any

import pytest
import torch
from hypothesis import given
from torch import Tensor

from apcc_torch.control.adaptive_dynamics import AdaptiveDynamics, DynamicsEstimate
from apcc_torch.errors import ShapeError, ValueRangeError
from apcc_torch.model.dynamics import SoftArmDynamics
from apcc_torch.model.dynamics_regressor import DynamicsRegressor
from apcc_torch.model.integrators import rk4_step
from apcc_torch.model.stiffness import scaled_stiffness
from apcc_torch.model.tendons import rack_routing
from arms import HANGING_BASE, PI
from laws import bits, check_bad_row, generator, normal, seeds, uniform

D = torch.float64
ROUTING = rack_routing(PI.cumsum(0))
TRUE = torch.tensor([0.0778, 10.0, 20.0, 0.3, 1.0], dtype=D)
NOMINAL = torch.tensor([0.1, 14.0, 30.0, 0.0, 1.0], dtype=D)
DEVIATION = torch.tensor([0.03, 5.0, 10.0, 0.3, 0.0], dtype=D)
DT = torch.tensor(2e-3, dtype=D)
REGRESSOR = DynamicsRegressor(ROUTING, HANGING_BASE)
FOLLOWING, HOLDING = 3.0, 0.05
"""Lambda, 1/s, and K_s, N m s/rad and N s/m."""


def law(nominal: Tensor = NOMINAL, deviation: Tensor = DEVIATION, **settings: Any) -> AdaptiveDynamics:
    own = {"tracking_gain": 0.0, "filter_time": 0.1, "torque_noise": 0.05}
    return AdaptiveDynamics(nominal, deviation, **{**own, **settings})


CASES = {
    "composite": (1.0, {}),
    "tracking error alone": (1.0, {"prediction": False}),
    "composite, standing still": (0.0, {}),
}
"""Name -> how far the desired motion swings, and settings of the law."""


def path(time: Tensor, swing: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """A desired motion (..., 9) and its rates; of swing (...) zero it stands still."""
    k = torch.arange(9, dtype=D)
    size = torch.tensor([0.5, 0.5, 0.01] * 3, dtype=D)
    pace = swing.unsqueeze(-1) * (2.0 + 0.7 * k)
    angle = pace * time + k
    return size * torch.sin(angle), size * pace * torch.cos(angle), -size * pace**2 * torch.sin(angle)


class Proof:
    """Arms that are the model, measured exactly, under tau = Y theta_hat - K_s s: the proof's case. A row a law."""

    def __init__(self, laws: list[AdaptiveDynamics], swing: Tensor) -> None:
        axial, bending = scaled_stiffness(PI, 1.0, TRUE[1], TRUE[0])
        self.arm = SoftArmDynamics(PI, TRUE[4] * PI / PI.sum(), axial, bending, 0.1, base_rotation=HANGING_BASE)
        B = ROUTING.matrix(PI)
        self.friction = TRUE[2] * B @ B.mT
        self.laws, self.swing = laws, swing

    def lyapunov(self, q: Tensor, e: Tensor, s: Tensor, estimates: list[DynamicsEstimate]) -> Tensor:
        """V (rows) = g (s^T M s + e^T K e) / 2 + (theta_hat - theta)^T P^-1 (theta_hat - theta) / 2.

        s^T K e is the rate of e^T K e / 2 and Lambda e^T K e, so elasticity at q_d, not at q, is part of V.
        """
        K, M = self.arm.stiffness_diagonal, self.arm.inertia(q, TRUE[3])
        motion = 0.5 * ((s * (M @ s.unsqueeze(-1)).squeeze(-1)).sum(-1) + (K * e * e).sum(-1))
        values, uncertain = [], DEVIATION > 0
        for row, (law, estimate) in enumerate(zip(self.laws, estimates, strict=True)):
            off = ((estimate.theta_hat - TRUE) / DEVIATION)[uncertain]
            information = estimate.information[uncertain][:, uncertain]
            values.append(law.tracking_gain * motion[row] + 0.5 * off @ information @ off)
        return torch.stack(values)

    def run(self, duration: float) -> tuple[Tensor, Tensor, Tensor]:
        """V (T, rows), |s| (T, rows) and theta_hat (T, rows, 5)."""
        q_d, rate, _ = path(torch.zeros((), dtype=D), self.swing)
        q, qdot = q_d + 0.1 * torch.tensor([1, -1, 0.05] * 3, dtype=D), rate.clone()
        estimates = [law.initial_estimate(row) for law, row in zip(self.laws, q, strict=True)]
        tau, log = torch.zeros_like(q), []
        for k in range(round(duration / float(DT))):
            q_d, rate, pull = path(k * DT, self.swing)
            e = q - q_d
            v = rate - FOLLOWING * e
            s, a = qdot - v, pull - FOLLOWING * (qdot - rate)
            qddot = self.arm(q, qdot, tau - qdot @ self.friction, TRUE[3])
            both = REGRESSOR(q, qdot, torch.stack((v, qdot)), torch.stack((a, qddot)), PI, torch.stack((q_d, q)))
            if k:
                estimates = [
                    law(one, Y, *rest, DT)
                    for law, one, Y, *rest in zip(self.laws, estimates, both[0], s, both[1], tau, strict=True)
                ]
            theta_hat = torch.stack([estimate.theta_hat for estimate in estimates])
            log.append((self.lyapunov(q, e, s, estimates), s.norm(dim=-1), theta_hat))
            tau = (both[0] @ theta_hat.unsqueeze(-1)).squeeze(-1) - HOLDING * s
            q, qdot = self.moved(q, qdot, tau)
        V, size, theta_hat = (torch.stack(field) for field in zip(*log, strict=True))
        return V, size, theta_hat

    def moved(self, q: Tensor, qdot: Tensor, tau: Tensor) -> tuple[Tensor, Tensor]:
        def field(_: Tensor, x: Tensor) -> Tensor:
            place, speed = x.split(9, dim=-1)
            return torch.cat((speed, self.arm(place, speed, tau - speed @ self.friction, TRUE[3])), dim=-1)

        later, speed = rk4_step(field, DT, torch.cat((q, qdot), dim=-1), float(DT)).split(9, dim=-1)
        return later, speed


@pytest.fixture(scope="module")
def proof() -> dict[str, tuple[Tensor, Tensor, Tensor]]:
    """Name of a case -> V (T,), |s| (T,), theta_hat (T, 5)."""
    laws = [law(tracking_gain=20.0, filter_time=0.05, memory=5.0, **settings) for _, settings in CASES.values()]
    swing = torch.tensor([swing for swing, _ in CASES.values()], dtype=D)
    with torch.inference_mode():
        found = Proof(laws, swing).run(1.2)
    return {name: tuple(field[:, row] for field in found) for row, name in enumerate(CASES)}  # type: ignore[misc]


Run = tuple[Tensor, Tensor, Tensor]


@pytest.mark.parametrize("case", CASES)
def test_v_falls_at_every_step(proof: dict[str, Run], case: str) -> None:
    V, _, _ = proof[case]
    assert float(V.diff().max()) < 0.0
    assert float(V[-1]) < (0.2 if case == "tracking error alone" else 0.02) * float(V[0])


@pytest.mark.parametrize("case", CASES)
def test_the_arm_comes_to_follow(proof: dict[str, Run], case: str) -> None:
    _, size, _ = proof[case]
    late, early = float(size[-100:].mean()), float(size[:100].mean())
    assert late < (0.3 if case == "tracking error alone" else 0.1) * early


def test_the_parameters_converge_where_they_are_excited(proof: dict[str, Run]) -> None:
    off = {case: ((theta_hat[-1] - TRUE) / TRUE).abs() for case, (_, _, theta_hat) in proof.items()}
    assert float(off["composite"].max()) < 0.03
    # The tracking error asks for no more than to follow.
    assert float(off["tracking error alone"][1]) > 0.3
    # At rest weight and rigidity still speak; what is known stays.
    assert float(off["composite, standing still"][[0, 3]].max()) < 0.01
    assert all(float(values[4]) == 0.0 for values in off.values())


def samples(count: int, seed: int = 0, rows: tuple[int, ...] = ()) -> tuple[Tensor, Tensor]:
    """Regressors (count, *rows, 9, 5) as of this arm, and forces that TRUE and some noise explain."""
    rng = generator(seed)
    unit = torch.tensor([0.5, 0.3, 0.3, 0.5, 0.5], dtype=D)
    W = unit / TRUE.clamp(min=0.1) * normal((count, *rows, 9, 5), D, rng)
    return W, (W @ TRUE.unsqueeze(-1)).squeeze(-1) + 0.02 * normal((count, *rows, 9), D, rng)


def fed(made: AdaptiveDynamics, W: Tensor, tau: Tensor, dt: Tensor = DT, s: Tensor | None = None) -> DynamicsEstimate:
    still = torch.zeros_like(tau[0])
    estimate = made.initial_estimate(still)
    for one, force in zip(W, tau, strict=True):
        estimate = made(estimate, one, still if s is None else s, one, force, dt)
    return estimate


def test_without_forgetting_it_is_least_squares() -> None:
    """min |theta - nominal|^2 / deviation^2 + dt / (T_f sigma^2) sum |W theta - tau_f|^2, with W and tau_f filtered."""
    made = law(memory=float("inf"), filter_time=0.02, torque_noise=0.3, length=0.2, lower=torch.zeros(5, dtype=D))
    W, tau = samples(200)
    estimate = fed(made, W, tau)
    share = 1.0 - torch.exp(-DT / 0.02)
    f, g, rows, sides = torch.zeros(9, 5, dtype=D), torch.zeros(9, dtype=D), [], []
    for one, force in zip(W, tau, strict=True):
        f, g = f + share * (one - f), g + share * (force - g)
        rows.append(f)
        sides.append(g)
    weight = torch.tensor([1.0, 1.0, 0.2] * 3, dtype=D) * (DT / 0.02).sqrt() / 0.3
    A = (weight.unsqueeze(-1) * torch.stack(rows)).flatten(0, 1)
    b = (weight * torch.stack(sides)).flatten() - A @ NOMINAL
    # The last parameter is known: its column is zero in units of its deviation.
    A = torch.cat((A * DEVIATION, torch.eye(5, dtype=D)))
    want = torch.linalg.lstsq(A, torch.cat((b, torch.zeros(5, dtype=D))).unsqueeze(-1)).solution.squeeze(-1)
    torch.testing.assert_close(estimate.theta_hat, NOMINAL + DEVIATION * want, rtol=1e-9, atol=1e-10)
    torch.testing.assert_close(estimate.information, A.mT @ A, rtol=1e-9, atol=1e-9)
    torch.testing.assert_close(estimate.regressor, f, rtol=1e-12, atol=1e-14)
    torch.testing.assert_close(made.prediction_error(estimate), f @ estimate.theta_hat - g, rtol=1e-10, atol=1e-12)


def test_no_acceleration_is_measured() -> None:
    """W of differences of velocities explains tau_f, the better the finer the steps: what passes is M qdot's change."""
    swing = torch.ones((), dtype=D)
    worst = []
    for dt in (4e-3, 2e-3):
        made, step = law(filter_time=0.1, prediction=False), torch.tensor(dt, dtype=D)
        times = dt * torch.arange(round(0.4 / dt), dtype=D)
        q, qdot, qddot = (torch.stack(part) for part in zip(*[path(time, swing) for time in times], strict=True))
        tau = (REGRESSOR(q, qdot, qdot, qddot, PI) @ TRUE.unsqueeze(-1)).squeeze(-1)
        differences = torch.cat((qddot[:1], qdot.diff(dim=0) / dt))
        estimate = fed(made, REGRESSOR(q, qdot, qdot, differences, PI), tau, step)
        worst.append(float((estimate.regressor @ TRUE - estimate.tau).norm() / estimate.tau.norm()))
    assert worst[0] < 0.01 and 1.7 < worst[0] / worst[1] < 2.3


def test_the_gain_is_forgotten_towards_the_prior() -> None:
    made = law(memory=0.05, torque_noise=0.01)
    W, tau = samples(50)
    learnt = fed(made, W, tau)
    excess = torch.linalg.eigvalsh(learnt.information - torch.eye(5, dtype=D))
    assert float(excess.max()) > 10.0 and float(excess.min()) > -1e-9
    still = torch.zeros(9, 5, dtype=D), torch.zeros(9, dtype=D)
    later = learnt
    for _ in range(2000):
        later = made(later, still[0], still[1], still[0], still[1], DT)
    torch.testing.assert_close(later.information, torch.eye(5, dtype=D), rtol=0, atol=1e-6)


@given(seed=seeds)
def test_bounds_hold_and_bring_nearer(seed: int) -> None:
    rng = generator(seed)
    upper = torch.tensor([0.2, 30.0, 60.0, 0.1, 1.0 + 1e-9], dtype=D)
    made = law(upper=upper, torque_noise=0.02)
    W, tau = samples(20, seed)
    tau = tau + 2.0 * normal((9,), D, rng)
    estimate = fed(made, W, tau)
    assert bool(((made.lower <= estimate.theta_hat) & (estimate.theta_hat <= made.upper)).all())


@given(seed=seeds)
def test_a_projection_brings_every_allowed_theta_nearer(seed: int) -> None:
    """In the norm of P^-1, where one bound is crossed."""
    rng = generator(seed)
    made = law(upper=torch.tensor([9.0, 99.0, 99.0, 0.1, 9.0], dtype=D), deviation=DEVIATION.clamp(min=0.2))
    factor = normal((5, 5), D, rng)
    information = 0.1 * factor @ factor.mT + torch.eye(5, dtype=D)
    inside = NOMINAL + torch.tensor([0.01, 1.0, -2.0, 0.05, 0.0], dtype=D) * uniform((5,), 0.0, 1.0, D, rng)
    theta = NOMINAL + torch.tensor([2.0, 0.0, 0.0, 0.3, 2.0], dtype=D)
    moved = made._projected(theta, torch.linalg.inv(information))
    before, after = ((value - inside) / made.deviation for value in (theta, moved))
    assert float(moved[3]) <= 0.1 and float(moved.min()) > 0.0, "no other bound is met"
    assert float(after @ information @ after) <= float(before @ information @ before)


def test_the_dead_zone_learns_nothing_from_small_errors() -> None:
    W, tau = samples(30)
    error = float((torch.tensor([1, 1, 0.1] * 3, dtype=D) * (W @ NOMINAL - tau)).norm(dim=-1).max())
    blind = fed(law(dead_zone=1.01 * error), W, tau)
    assert torch.equal(blind.theta_hat, NOMINAL)
    torch.testing.assert_close(blind.information, torch.eye(5, dtype=D), rtol=0, atol=1e-12)
    part, whole = fed(law(dead_zone=0.01 * error), W, tau), fed(law(), W, tau)
    assert float((part.theta_hat - NOMINAL).norm()) > 0.0
    assert 5.0 < float(torch.trace(part.information)) < float(torch.trace(whole.information))


def test_rows_and_what_is_not_finite() -> None:
    made = law(tracking_gain=1.0)
    W, tau = samples(3, rows=(4,))
    start = fed(made, W, tau)
    Y, s = samples(1, 5, (4,))
    dt = DT.expand(4).clone()
    check_bad_row(lambda *given: made(*given), (start, Y[0], s[0], W[0], tau[0], dt))
    row = made(DynamicsEstimate(*(field[2] for field in start)), Y[0, 2], s[0, 2], W[0, 2], tau[0, 2], DT)
    whole = made(start, Y[0], s[0], W[0], tau[0], dt)
    for have, want in zip(row, whole, strict=True):
        torch.testing.assert_close(have, want[2], rtol=1e-10, atol=1e-12)
    # Without forces the prediction waits and the tracking error goes on; without either nothing moves.
    blind = made(start, Y[0], s[0], W[0], torch.full_like(tau[0], torch.nan), dt)
    assert torch.equal(bits(blind.regressor), bits(start.regressor)) and torch.equal(bits(blind.tau), bits(start.tau))
    assert bool((blind.theta_hat[:, :4] != start.theta_hat[:, :4]).any())
    lost = made(start, Y[0] * torch.nan, s[0], W[0], tau[0], dt)
    assert torch.equal(lost.theta_hat, start.theta_hat) and torch.equal(lost.information, start.information)


@pytest.mark.parametrize(
    ("settings", "named"),
    [
        ({"deviation": -DEVIATION}, "deviation"),
        ({"lower": 2.0 * NOMINAL + 1.0}, "nominal must be between"),
        ({"lower": -TRUE}, "lower must not be negative"),
        ({"memory": 0.0}, "memory"),
        ({"filter_time": 0.0}, "filter_time"),
        ({"torque_noise": float("nan")}, "torque_noise"),
        ({"tracking_gain": -1.0}, "tracking_gain"),
        ({"dead_zone": float("inf")}, "dead_zone"),
        ({"length": 0.0}, "length"),
    ],
)
def test_settings_without_meaning_are_refused(settings: dict[str, Any], named: str) -> None:
    with pytest.raises(ValueRangeError, match=named):
        law(**settings)


def test_shapes_that_do_not_fit_are_named() -> None:
    with pytest.raises(ShapeError, match=r"deviation must have shape \(\.\.\., 5\)"):
        law(deviation=DEVIATION[:4])
    W, tau = samples(1)
    made = law()
    with pytest.raises(ShapeError, match=r"Y must have shape \(\.\.\., 9, 5\)"):
        made(made.initial_estimate(tau[0]), W[0, :, :4], tau[0], W[0], tau[0], DT)
