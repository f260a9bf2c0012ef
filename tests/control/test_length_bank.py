"""The bank of models against its definition, arms whose lengths it holds, and the gradient law's wrong valley."""

from __future__ import annotations

import itertools

import pytest
import torch
from hypothesis import given, settings
from torch import Tensor

from apcc_torch.control.adaptation import AdaptiveLaw, NormalisedLaw
from apcc_torch.control.controller import APCCController
from apcc_torch.control.inverse_kinematics import InverseKinematics
from apcc_torch.control.length_bank import UNSEEN, BankEvidence, LengthBank, Shares, candidates, lists_of
from apcc_torch.control.length_bounds import LengthBounds
from apcc_torch.control.length_law import LengthLaw
from apcc_torch.control.residual_adaptation import ResidualLaw
from apcc_torch.control.step_io import Measurement, Target
from apcc_torch.errors import ConfigError, ValueRangeError
from apcc_torch.estimation.savitzky_golay import SavitzkyGolay
from apcc_torch.estimation.sensor_curve import SensorCurve
from apcc_torch.estimation.state_feedback import StateFeedback
from apcc_torch.model.abscissae import decouple
from apcc_torch.model.backbone import PCCBackbone
from apcc_torch.model.dynamics import SoftArmDynamics
from apcc_torch.model.statics import equilibrium
from apcc_torch.model.stiffness import scaled_stiffness
from apcc_torch.model.tendons import rack_routing
from arms import HANGING_BASE, PI, configurations
from law_steps import law_step
from laws import bits, generator, seeds, uniform

D = torch.float64
BACKBONE = PCCBackbone(3, HANGING_BASE)
SENSORS = torch.tensor([0.105, 0.36, 0.6], dtype=D)
CURVE = SensorCurve(HANGING_BASE, SENSORS, samples=4)
FEEDBACK = StateFeedback(BACKBONE, SENSORS, "pose", angular_weight=0.05, max_iterations=30)
SHARES = (0.5, 0.75, 1.0)
QUICK: dict[str, object] = {"sharpness": 0.1, "memory": 0.0, "time_constant": 0.3, "rate": 0.1}
BENT = torch.tensor([0.5, -0.2, 0.0, -0.7, 0.4, 0.0, 0.6, 0.5, 0.0], dtype=D)
DT = torch.tensor(0.02, dtype=D)


def bank(**settings: object) -> LengthBank:
    return LengthBank(PI, FEEDBACK, **{"shares": SHARES, **QUICK, **settings})


def models(nominal: Tensor = PI, shares: Shares = SHARES, sensors: Tensor = SENSORS) -> Tensor:
    """The rest lengths that are tried."""
    return candidates(nominal, lists_of(shares, nominal.shape[-1] - 1), sensors)


def measured(q: Tensor, pi: Tensor = PI) -> Tensor:
    return BACKBONE.pose(q, pi, *decouple(SENSORS, pi))


def visits(made: LengthBank, T: Tensor, steps: int) -> tuple[Tensor, BankEvidence]:
    """pi_hat and the evidence after so many steps on an arm at rest."""
    batch = T.shape[:-3]
    q = torch.zeros(*batch, 9, dtype=D)
    pi, evidence = PI.expand(*batch, 3), made.initial_memory(q, PI)
    for _ in range(steps):
        velocity, evidence = made.speed(law_step(FEEDBACK, q, pi, T, DT, sensitivity=False), evidence)
        pi = pi + DT * velocity
    return pi, evidence


def test_the_models_are_all_combinations_that_keep_the_total_length() -> None:
    found = models()
    assert found.shape == (9, 3) and torch.equal(found[0], PI)
    torch.testing.assert_close(found.sum(-1), PI.sum().expand(9))
    want = {(round(float(PI[0]) * a, 6), round(float(PI[1]) * b, 6)) for a, b in itertools.product(SHARES, SHARES)}
    assert {(round(float(a), 6), round(float(b), 6)) for a, b, _ in found} == want


@settings(max_examples=2)
@given(seed=seeds)
def test_a_row_is_the_same_alone_and_in_a_batch(seed: int) -> None:
    # Arms so different that the sensors tell other combinations of each.
    rng = generator(seed)
    nominal = PI * uniform((4, 3), 0.6, 1.3, D, rng)
    q = uniform((4, 9), -0.4, 0.4, D, rng) * torch.tensor([1.0, 1.0, 0.02] * 3, dtype=D)
    T, dt = BACKBONE.pose(q, nominal, *decouple(SENSORS, nominal)), DT

    def followed(rows: int | slice) -> Tensor:
        laws: list[LengthLaw] = [
            LengthBank(nominal[rows], FEEDBACK, shares=SHARES, stretch=1.0, **{**QUICK, "memory": 0.5}),
            ResidualLaw(nominal[rows], FEEDBACK),
            NormalisedLaw(3),
            AdaptiveLaw(3, regressor="partial"),
        ]
        pi = (nominal * 1.02)[rows]
        memories = [law.initial_memory(q[rows], pi) for law in laws]
        for _ in range(7):
            step = law_step(FEEDBACK, q[rows], pi, T[rows], dt)._replace(qdot=q[rows], e=0.1 * q[rows][..., :3])
            speeds = []
            for k, law in enumerate(laws):
                speed, memories[k] = law.speed(step, memories[k])
                speeds.append(speed)
            pi = pi + dt * speeds[0]
        return torch.stack(speeds, dim=-2)

    together = followed(slice(None))
    for row in range(2):
        torch.testing.assert_close(together[row], followed(row), rtol=1e-9, atol=1e-9)


def test_every_section_may_have_shares_of_its_own() -> None:
    found = models(PI, ((0.5, 1.0), (0.75,)))
    want = torch.stack(
        [PI, *(torch.stack((a * PI[0], 0.75 * PI[1], PI.sum() - a * PI[0] - 0.75 * PI[1])) for a in (0.5, 1.0))]
    )
    torch.testing.assert_close(found, want)
    torch.testing.assert_close(models(PI, (SHARES, SHARES)), models())
    # A profile from the base to the tip: each section has the list of its place, whatever their number.
    profile = ["along", (0.5, 1.0), (0.75,)]
    torch.testing.assert_close(torch.stack(lists_of(profile, 2)[:1]), torch.tensor([[0.5, 1.0]], dtype=D))
    assert [each.tolist() for each in lists_of(profile, 4)] == [[0.5, 1.0], [0.5, 1.0], [0.75], [0.75]]
    assert [each.tolist() for each in lists_of(profile, 1)] == [[0.75]]


@pytest.mark.parametrize(
    ("stretch", "total_range", "true", "want"),
    [
        (1.0, 0.1, 0.95, 0.95),  # the whole of what the model is compressed
        (0.5, 0.1, 0.95, 0.975),
        (0.0, 0.1, 0.95, 1.0),
        (1.0, 0.02, 0.95, 0.98),  # no further than the range
        (1.0, 0.1, 1.05, 1.0),  # the last sensor stays on the tip
    ],
)
def test_the_total_length_follows_the_compression(stretch: float, total_range: float, true: float, want: float) -> None:
    # An arm of other lengths, unstretched: with the tip's sensor on its tip.
    arm = true * PI
    T = BACKBONE.pose(BENT, arm, *decouple(true * SENSORS, arm))
    made = bank(stretch=stretch, total_range=total_range)
    pi, q, evidence = PI, torch.zeros(9, dtype=D), made.initial_memory(torch.zeros(9, dtype=D), PI)
    for _ in range(160):
        q = FEEDBACK(q, pi, T).q_bar
        velocity, evidence = made.speed(law_step(FEEDBACK, q, pi, T, DT, sensitivity=False), evidence)
        pi = pi + DT * velocity
    assert float(pi.sum() / PI.sum()) == pytest.approx(want, abs=2e-3)


def test_an_estimate_that_is_not_finite_moves_nothing() -> None:
    made = bank(stretch=1.0)
    q = torch.stack((BENT, torch.full_like(BENT, float("nan"))))
    pi, T = PI.expand(2, 3), measured(BENT).expand(2, 3, 4, 4)
    evidence = made.initial_memory(torch.zeros(2, 9, dtype=D), PI)
    velocity, _ = made.speed(law_step(FEEDBACK, q, pi, T, DT, sensitivity=False), evidence)
    alone, _ = made.speed(law_step(FEEDBACK, BENT, PI, T[0], DT), made.initial_memory(q[0] * 0, PI))
    assert not bool(velocity[1].any())
    torch.testing.assert_close(velocity[0], alone)


def test_models_that_the_sensors_cannot_tell_are_left_out() -> None:
    # Where the sensors leave sections open, algorithm 2's problem is singular; for what is kept it is not.
    even, X = torch.full((3,), 0.15, dtype=D), torch.tensor([0.15, 0.3, 0.45], dtype=D)
    shares = (0.3, 0.6, 0.9, 1.2)
    kept = {tuple(round(float(v), 6) for v in row) for row in models(even, shares, X)}
    every = [(0.15 * a, 0.15 * b, 0.45 - 0.15 * (a + b)) for a, b in itertools.product(shares, shares)]
    q = torch.tensor([0.4, 0.3, 0.0, -0.5, 0.2, 0.0, 0.3, -0.4, 0.0], dtype=D)
    worst = {True: float("inf"), False: 0.0}
    for lengths in every:
        pi = torch.tensor(lengths, dtype=D)
        J = BACKBONE.body_jacobian(q, pi, *decouple(X, pi))[:, 3:].flatten(0, 1)
        singular = float(torch.linalg.svdvals(J)[-1])
        told = tuple(round(v, 6) for v in lengths) in kept
        worst[told] = min(worst[told], singular) if told else max(worst[told], singular)
    assert len(kept) < 1 + len(every)
    assert worst[False] < 1e-12 < 1e-6 < worst[True]


@given(seed=seeds)
def test_the_cost_is_its_definition(seed: int) -> None:
    rng = generator(seed)
    q, pi = configurations((), 3, D, rng, bend=0.5, elongation=0.01), 0.9 * PI
    T = measured(configurations((), 3, D, rng, bend=0.5, elongation=0.01))
    made = bank(elongation_weight=0.3, nominal_weight=0.2)
    total = torch.zeros((), dtype=D)
    for X, point in zip(CURVE.abscissae, CURVE(T), strict=True):
        # As far along the model, whose total length is another, as X is along the arm.
        (pose,) = BACKBONE.pose(q, pi, *decouple(0.9 * X.unsqueeze(0), pi))
        local = torch.linalg.solve(pose, torch.cat((point, torch.ones(1, dtype=D))))
        total = total + local[:2].square().sum()
    mean = total / (2 * CURVE.abscissae.shape[0])
    want = mean + 0.09 * q[2::3].square().sum() + 0.04 * (pi - PI).square().sum()
    torch.testing.assert_close(made.cost(BACKBONE, q, pi, T), want)


@pytest.mark.parametrize("model", [0, 2, 4, 7])
def test_the_best_model_is_found(model: int) -> None:
    tried = models()
    T = measured(0.4 * BENT, tried[model])
    made = bank(sharpness=0.02, time_constant=0.1, elongation_weight=0.0, nominal_weight=0.0)
    alone = [made.cost(BACKBONE, FEEDBACK(torch.zeros(9, dtype=D), pi, T).q_bar, pi, T) for pi in tried]
    best = int(torch.stack(alone).argmin())
    pi, evidence = visits(made, T, 100)
    assert int(evidence.cost.argmin()) == best
    torch.testing.assert_close(pi, tried[best], atol=2e-3, rtol=0.0)
    if model != 4:  # there the curve through the sensors, no arc, lies nearer to another model
        assert best == model


def test_where_the_gradient_goes_astray_the_bank_does_not() -> None:
    # An arm of six sections under half a kilogram, its tendons pulled to a hard shape: downhill the second section
    # vanishes, and the model is worse than it was.
    lengths = torch.tensor([0.0525, 0.0525, 0.1275, 0.1275, 0.12, 0.12], dtype=D)
    arm = SoftArmDynamics(lengths, lengths / lengths.sum(), *scaled_stiffness(lengths), base_rotation=HANGING_BASE)
    routing = rack_routing(SENSORS)
    wanted = torch.tensor([-1.617, -0.261, 0.0, 0.7, -0.619, 0.0, -0.436, -0.607, 0.0], dtype=D)
    pulled = BACKBONE.tendon_lengths(routing, wanted, PI)
    rest = equilibrium(arm, routing=routing, tendon_lengths=pulled, payload=torch.tensor(0.5, dtype=D))
    assert bool(rest.converged)
    T = PCCBackbone(6, HANGING_BASE).pose(rest.q, lengths, *decouple(SENSORS, lengths))
    weights = {"elongation_weight": 0.02, "nominal_weight": 0.002, "time_constant": 0.1, "rate": 0.3, "samples": 4}
    gradient, pi = ResidualLaw(PI, FEEDBACK, damping=0.02, **weights), PI
    q = torch.zeros(9, dtype=D)
    for _ in range(150):
        q = FEEDBACK(q, pi, T).q_bar
        velocity, _ = gradient.speed(law_step(FEEDBACK, q, pi, T, DT), None)
        pi = (pi + DT * velocity).clamp(min=0.03)
    made = LengthBank(PI, FEEDBACK, sharpness=0.1, memory=0.0, **weights)
    found, _ = visits(made, T, 100)
    nominal, astray, best = (
        made.cost(BACKBONE, FEEDBACK(torch.zeros(9, dtype=D), p, T).q_bar, p, T).sqrt() for p in (PI, pi, found)
    )
    assert best < 0.75 * nominal < 0.75 * astray


def test_one_model_is_visited_a_step() -> None:
    made, T = bank(), measured(BENT)
    _, before = visits(made, T, 3)
    _, after = visits(made, T, 4)
    assert int(before.turn) == 3 and int(after.turn) == 4
    moved = (after.q != before.q).any(-1)
    assert moved.nonzero().flatten().tolist() == [3]
    assert (after.cost == UNSEEN).sum() == 5
    _, round_trip = visits(made, T, 9)
    assert int(round_trip.turn) == 0 and bool((round_trip.cost < UNSEEN).all())


def test_a_straight_arm_says_nothing() -> None:
    pi, _ = visits(bank(), measured(torch.zeros(9, dtype=D)), 30)
    torch.testing.assert_close(pi, PI, atol=1e-4, rtol=0.0)


def test_memory_is_a_forgetting_mean_of_a_models_visits() -> None:
    made, q = bank(memory=0.5), torch.zeros(9, dtype=D)
    T, later = measured(BENT), measured(0.8 * BENT)
    _, evidence = visits(made, T, 9)
    alone = made.cost(BACKBONE, made.feedback(evidence.q[0], PI, later).q_bar, PI, later)
    _, after = made.speed(law_step(FEEDBACK, q, PI, later, DT), evidence)
    keep = torch.exp(-9 * DT / 0.5)
    torch.testing.assert_close(after.cost[0], keep * evidence.cost[0] + (1 - keep) * alone)


def test_a_bad_row_stays_alone_and_waits() -> None:
    T = measured(BENT).repeat(3, 1, 1, 1)
    bad = T.clone()
    bad[1, 2] = torch.nan
    good, all_seen = visits(bank(), T, 15)
    pi, evidence = visits(bank(), bad, 15)
    assert torch.equal(bits(pi[[0, 2]]), bits(good[[0, 2]]))
    assert torch.equal(pi[1], PI) and int(evidence.turn[1]) == 0 and bool((evidence.cost[1] == UNSEEN).all())
    assert bool(torch.isfinite(evidence.q).all())
    torch.testing.assert_close(visits(bank(), T[0], 15)[0], good[0])
    assert int(all_seen.turn[1]) == 6


def test_in_the_controller_the_bounds_hold() -> None:
    bounds = LengthBounds(PI, reach="free", lower=0.9, upper=None)
    parts = SavitzkyGolay(5, 2), InverseKinematics(1.0, null_gain=0.05), bank()
    controller = APCCController(BACKBONE, FEEDBACK, *parts, bounds=bounds)
    T, target = measured(BENT, models()[1]), Target(torch.tensor([0.1, 0.1, -0.5], dtype=D), 0 * PI)
    state = controller.initial_state(BENT, PI)
    for k in range(40):
        state, command = controller(state, Measurement(T, (k + 1) * DT), target)
    torch.testing.assert_close(state.pi_hat[:2], 0.9 * PI[:2])
    assert state.pi_hat[2] > PI[2] and bool(torch.isfinite(command.qdot).all())


def test_gradients_pass() -> None:
    q = BENT.clone().requires_grad_()
    pi, _ = visits(bank(), measured(q, models()[4]), 12)
    (slope,) = torch.autograd.grad(pi[0], q)
    assert bool(torch.isfinite(slope).all()) and bool(slope.any())


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"time_constant": 0.0}, "time_constant must be positive"),
        ({"rate": -1.0}, "rate must be positive"),
        ({"resolution": 0.0}, "resolution must be positive"),
        ({"sharpness": -0.1}, "sharpness must be zero or positive"),
        ({"memory": float("nan")}, "memory must be zero or positive"),
        ({"stretch": -0.1}, "stretch must be"),
        ({"total_range": 1.0}, r"total_range must be in \[0, 1\)"),
        ({"shares": ()}, "shares must be positive"),
        ({"shares": ("long",)}, "shares must be positive"),
        ({"shares": ((0.5, 1.0), ())}, "shares must be positive"),
        ({"shares": ((0.5, 1.0),)}, "shares must be one list of numbers, or 2 lists"),
        ({"shares": ((0.5, 1.0), 1.0)}, "shares must be one list of numbers, or 2 lists"),
        ({"shares": (0.5, -1.0)}, "shares must be positive"),
    ],
)
def test_bad_settings(settings: dict[str, object], message: str) -> None:
    with pytest.raises(ValueRangeError, match=message):
        LengthBank(PI, FEEDBACK, **settings)


@pytest.mark.parametrize(
    ("nominal", "shares", "sensors", "message"),
    [
        (PI, (1.0,), SENSORS, "needs two sections or more and shares other than 1"),
        (PI[:1], SHARES, SENSORS, "needs two sections or more"),
        (PI, SHARES, SENSORS[:2], "with 3 sections needs at least 3 sensors, got 2"),
    ],
)
def test_a_bank_without_models_is_refused(nominal: Tensor, shares: tuple[float], sensors: Tensor, message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        models(nominal, shares, sensors)


def test_where_no_share_leaves_lengths_that_the_sensors_can_tell_the_nominal_ones_stay() -> None:
    assert torch.equal(models(PI, (3.0,)), PI.unsqueeze(0))
    pi, _ = visits(LengthBank(PI, FEEDBACK, shares=(3.0,), **QUICK), measured(BENT), 5)
    torch.testing.assert_close(pi, PI)
