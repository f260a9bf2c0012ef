"""The look ahead: its mean, its model against a simulation, its costs, and what it may never do to Eq. (16)."""

from __future__ import annotations

from functools import cache
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor

from apcc_torch.control.ahead import AheadStatus
from apcc_torch.control.control_settings import ControlSettings
from apcc_torch.control.controller import APCCController
from apcc_torch.control.lookahead import mean_of
from apcc_torch.control.lookahead_controller import LookaheadController
from apcc_torch.control.lookahead_settings import LookaheadSettings
from apcc_torch.control.obstacles import Sphere
from apcc_torch.control.predicted_loop import Outlook, Predicted
from apcc_torch.control.step_io import ControllerState, Measurement, Target
from apcc_torch.control.trajectory import SetPoint
from apcc_torch.errors import ConfigError
from apcc_torch.model.abscissae import decouple
from apcc_torch.model.affine import AffineBackbone
from apcc_torch.model.arm import Arm
from apcc_torch.model.chambers import Chambers
from apcc_torch.native.structure import mapped
from apcc_torch.simulation.dynamic import DynamicLog, DynamicSettings, simulate_dynamic
from apcc_torch.simulation.plant import Plant, PlantSettings
from apcc_torch.simulation.sensors import PoseSensors

D = torch.float64
ARM = Arm(lengths=[0.2, 0.25], mass=0.4)
LENGTHS = ARM.rest_lengths()
X_D = torch.tensor([[0.12, 0.05, -0.40], [-0.1, 0.1, -0.42], [0.0, -0.15, -0.40]], dtype=D)
SMALL = {"samples": 24, "steps": 5, "batch": 3}


def controller(adaptation: Any = None, base: str = "lookahead", **settings: Any) -> Any:
    changes = {"adaptation": adaptation, "K": 1.8, "angular_weight": 0.03}
    if base == "plain":
        return APCCController.for_arm(ARM, **changes)
    return LookaheadController.for_arm(ARM, lookahead=LookaheadSettings(**{**SMALL, **settings}), **changes)


def measured(q: Tensor, time: float) -> Measurement:
    T = ARM.backbone().pose(q, LENGTHS, *decouple(ARM.sensor_places(), LENGTHS))
    return Measurement(T, torch.tensor(time, dtype=D))


def target(rows: slice | int = slice(None)) -> Target:
    return Target(X_D[rows], torch.zeros_like(X_D[rows]))


def bent(rows: int = 3) -> Tensor:
    chance = torch.Generator().manual_seed(1)
    q = 0.2 * torch.randn(rows, 6, generator=chance, dtype=D)
    q[:, 2::3] *= 0.02
    return q


def stepped(of: Any, q: Tensor, aim: Target, steps: int = 3) -> ControllerState:
    state = of.initial_state(q, LENGTHS)
    for k in range(steps):
        state, _ = of(state, measured(q, 0.01 * (k + 1)), aim)
    return state


def test_the_mean_is_the_softmax_of_what_ways_cost() -> None:
    chance = np.random.default_rng(0)
    knots, best = chance.normal(size=(2, 50, 3, 4)), chance.normal(size=(3, 4))
    cost = np.square(knots - best).sum((-1, -2))
    cost[1, 7] = np.inf
    wanted = []
    for row in range(2):
        finite = np.isfinite(cost[row])
        above = cost[row][finite] - cost[row].min()
        weights = np.exp(-above / (0.2 * above.mean()))
        wanted.append((weights[:, None, None] * knots[row][finite]).sum(0) / weights.sum())
    found = mean_of(torch.from_numpy(knots), torch.from_numpy(cost), 0.2)
    np.testing.assert_allclose(found.numpy(), np.array(wanted), rtol=1e-12)
    cold = mean_of(torch.from_numpy(knots), torch.from_numpy(cost), 1e-4)
    np.testing.assert_allclose(cold[0].numpy(), knots[0, cost[0].argmin()], atol=1e-9)


def test_without_a_finite_way_the_mean_is_none_at_all() -> None:
    assert (mean_of(torch.ones(5, 2, 3), torch.full((5,), torch.inf), 0.1) == 0.0).all()


def test_a_departure_runs_straight_from_knot_to_knot() -> None:
    loop = controller().lookahead
    knots = torch.randn(4, 3, 9, generator=torch.Generator().manual_seed(0), dtype=D)
    at = torch.tensor([0.0, 0.07, 0.2, 0.4], dtype=D)
    grid = np.linspace(0.0, 0.3, 3)
    for row in range(4):
        straight = [np.interp(float(at[row]), grid, knots[row, :, i].numpy()) for i in range(9)]
        np.testing.assert_allclose(loop.loop.departure(knots, at)[row].numpy(), straight, atol=1e-12)
        later = [np.interp(grid + float(at[row]), grid, knots[row, :, i].numpy()) for i in range(9)]
        np.testing.assert_allclose(loop.shifted(knots, at)[row].numpy(), np.array(later).T, atol=1e-12)


def test_a_state_without_a_look_steps_as_the_controller_without_one() -> None:
    """What a deadline leaves is Eq. (16), to the last bit."""
    ahead, plain, q = controller(), controller(base="plain"), bent()
    state, other = stepped(ahead, q, target()), stepped(plain, q, target())
    assert state.ahead is not None and (state.ahead.status == AheadStatus.NONE).all()
    for field in ("q_bar", "qdot", "q_d", "pi_hat"):
        assert torch.equal(getattr(state, field), getattr(other, field))


def test_a_look_is_taken_once_and_named() -> None:
    ahead, q = controller(), bent()
    looked = ahead.look_ahead(stepped(ahead, q, target()), target())
    assert looked.ahead.number.tolist() == [1, 1, 1] and (looked.ahead.age == 0.0).all()
    state, command = ahead(looked, measured(q, 0.04), target())
    assert torch.equal(state.ahead.status, looked.ahead.next) and (state.ahead.next == AheadStatus.NONE).all()
    departed = (command.qdot - ahead(stepped(ahead, q, target()), measured(q, 0.04), target())[1].qdot).abs().amax(-1)
    assert torch.equal(departed > 0.0, looked.ahead.next == AheadStatus.FOLLOWED)
    assert (looked.ahead.next == AheadStatus.FOLLOWED).any()
    again, _ = ahead(state, measured(q, 0.05), target())
    assert (again.ahead.status == AheadStatus.NONE).all()


def start_of(of: LookaheadController, state: ControllerState, aim: Target) -> tuple[Predicted, Outlook]:
    """What a look begins with, for arms whose model is the arm."""
    a = state.ahead
    assert a is not None
    zero, still = torch.zeros_like(a.age), torch.zeros_like(aim.x_d)
    now = Predicted(a.q, torch.zeros_like(a.q), state.q_d, a.y, aim.x_d - a.x, still, zero, zero)
    return now, outlook_of(aim.x_d, zero, torch.zeros_like(a.q))


def outlook_of(x_d: Tensor, payload: Tensor, d: Tensor) -> Outlook:
    """Targets (R, 3) that rest, seen by arms of the model's own lengths."""
    still, apart, B_hat = torch.zeros_like(x_d), torch.zeros(len(x_d), 6, dtype=D), ARM.routing().matrix(LENGTHS)
    return Outlook(x_d, still, still, still, apart, B_hat.expand(len(x_d), 6, -1), payload, d)


def test_no_way_that_is_taken_costs_more_than_eq_16() -> None:
    of, q = controller(), bent()
    state = stepped(of, q, target())
    now, outlook = start_of(of, state, target())
    mean = torch.zeros(3, 3, 9, dtype=D)
    for number in range(3):
        way = of.lookahead(now, outlook, mean, torch.full((3,), number))
        assert (way.cost <= way.alone).all()
        none = of.lookahead.cost(now, torch.zeros(3, 1, 3, 9, dtype=D), outlook, of.rollouts("off"))[:, 0]
        torch.testing.assert_close(way.alone, none, rtol=1e-12, atol=0.0)
        mean = way.knots
    still = controller(tip_spread=0.0, tip_floor=0.0, bend_spread=0.0, length_spread=0.0)
    way = still.lookahead(now, outlook, torch.zeros(3, 3, 9, dtype=D), torch.zeros(3, dtype=torch.int64))
    assert (way.status == AheadStatus.NOT_BETTER).all() and (way.knots == 0.0).all()
    assert torch.equal(way.cost, way.alone)


@cache
def simulated(look: bool, duration: float = 0.6, payload: float = 0.0) -> DynamicLog:
    """A loop on an arm of the model's own sections."""
    of = controller(steps=15, approach=4.0) if look else controller(base="plain")
    plant = Plant.on(ARM, torch.full((3,), payload, dtype=D), PlantSettings(refine=1, settle=2.0))
    settings = DynamicSettings(duration=duration, control_rate=50.0)
    return simulate_dynamic(plant, of, PoseSensors(), SetPoint(X_D), LENGTHS, settings)


def test_the_model_moves_as_the_arm_that_it_is_of() -> None:
    """Where arm and model are one, 0.3 s are predicted to a few per cent of the way, by half the steps of the plant."""
    of = controller(steps=15, horizon=0.3)
    log = simulated(False)
    k = 10
    q_true, q_d = log.q_true[k], log.q_d[k]
    y = log.y_d[k + 1]  # told in the period that begins
    rate = (log.q_true[k] - log.q_true[k - 1]) / 0.02
    zero, still = torch.zeros(3, dtype=D), torch.zeros(3, 3, dtype=D)
    now = Predicted(q_true, rate, q_d, y, X_D - log.x[k], still, zero, zero)
    outlook = outlook_of(X_D, zero, torch.zeros_like(q_true))
    later = of.rollouts("off")(now, torch.zeros(3, 3, 9, dtype=D), outlook, repeats=15)
    tip = ARM.backbone().tip(later.q, LENGTHS)
    moved = (log.x[k + 15] - log.x[k]).norm(dim=-1)
    assert (moved > 0.02).all()
    assert ((tip - log.x[k + 15]).norm(dim=-1) < 0.08 * moved).all()
    assert ((later.q_d - log.q_d[k + 15]).norm(dim=-1) < 0.08 * (log.q_d[k + 15] - q_d).norm(dim=-1)).all()


def test_a_loop_that_looks_ahead_is_sooner_there() -> None:
    plain, ahead = (((log.x_d - log.x).norm(dim=-1))[-1] for log in (simulated(False), simulated(True)))
    assert (ahead < 0.8 * plain).all()


@pytest.mark.parametrize("pi", [(0.2, 0.25), (0.23, 0.25), (0.17, 0.28), (0.17, 0.24)])
def test_the_arms_own_sections_are_told_whatever_lengths_the_model_has(pi: tuple[float, float]) -> None:
    """Strain is what stretches of material have: summed here over a fine grid of it. A model that ends too soon has
    its tip where the arm's is.
    """
    of, q_bar, lengths = controller(), bent()[0], torch.tensor(pi, dtype=D)
    N = 45_000
    X = (np.arange(N) + 0.5) * 0.45 / N
    begins = np.array([0.0, pi[0]])
    section = np.searchsorted(begins, X, side="right") - 1
    strain = q_bar.unflatten(-1, (2, 3)).numpy() / np.array(pi)[:, None]
    density = strain[section] * (sum(pi) > X)[:, None] * 0.45 / N
    want = np.stack([density[X < 0.2].sum(0), density[X > 0.2].sum(0)]).reshape(-1)
    want[-1] += min(sum(pi) - 0.45, 0.0)
    state = of.initial_state(q_bar, lengths)
    assert state.ahead is not None
    np.testing.assert_allclose(state.ahead.q.numpy(), want, atol=2e-6)
    if pi == (0.2, 0.25):
        np.testing.assert_allclose(state.ahead.q.numpy(), q_bar.numpy(), atol=1e-15)


def test_the_payload_is_what_the_forces_leave() -> None:
    """On an arm that is the model, at rest: to a gram or two, with nothing left for a force without a name."""
    of = controller()
    plant = Plant.on(ARM, torch.tensor([0.0, 0.1, 0.2], dtype=D), PlantSettings(refine=1, settle=4.0))
    arm = plant.settled(4.0, 0.01)
    q, held = arm.arm.q, plant.at_rest(arm.z)
    state = of.initial_state(q, LENGTHS)
    state = state._replace(ahead=state.ahead._replace(y=torch.zeros_like(held.y_d)))
    for k in range(60):
        hanging = Target(of.backbone.tip(q, LENGTHS), torch.zeros(3, 3, dtype=D))
        state, _ = of(state, measured(q, 0.02 * (k + 1)), hanging)
        still = torch.zeros_like(held.y_d)  # what the tendons are held at, whatever the controller says
        state = state._replace(ahead=state.ahead._replace(y=still, ydot=still))
    torch.testing.assert_close(state.ahead.payload, torch.tensor([0.0, 0.1, 0.2], dtype=D), atol=3e-3, rtol=0.0)


def test_an_obstacle_costs_what_points_are_within_its_distance() -> None:
    ball = Sphere(torch.tensor([0.05, 0.0, -0.3], dtype=D), 0.02)
    of, free = controller(spheres=((0.05, 0.0, -0.3, 0.02),), radius=0.02, clearance=0.03, intrusion=2e-3), controller()
    q = bent()
    knots = torch.zeros(3, 3, 9, dtype=D)
    now, outlook = start_of(of, stepped(of, q, target()), target())
    costs = [each.lookahead.loop(now, knots, outlook).cost for each in (of, free)]
    X = torch.linspace(0.0, 1.0, 13, dtype=D)[1:] * LENGTHS.sum()
    points = ARM.backbone().pose(now.q, LENGTHS, *decouple(X, LENGTHS))[..., :3, 3]
    within = (0.03 - (ball(points)[0] - 0.02)).clamp(min=0.0) / 2e-3
    torch.testing.assert_close(costs[0] - costs[1], within.square().sum(-1) / 5.0, rtol=1e-9, atol=1e-9)
    assert (costs[0] > costs[1]).any()


def test_limits_cost_what_is_past_them() -> None:
    state = stepped(controller(), bent(), target())
    knots = torch.zeros(3, 3, 9, dtype=D)
    now, outlook = start_of(controller(), state, target())
    now = now._replace(y=now.y + 0.02)
    free = controller().lookahead.loop
    u = 750.0 * (now.y - free.tendons(now.q))
    for limits, past in (
        ({"force_limit": 5.0}, u.abs() / 5.0 - 1.0),
        ({"length_limit": 0.01}, now.y.abs() / 0.01 - 1.0),
    ):
        extra = controller(**limits).lookahead.loop(now, knots, outlook).cost - free(now, knots, outlook).cost
        torch.testing.assert_close(extra, (past.clamp(min=0.0) / 0.1).square().sum(-1) / 5.0)


def test_a_bad_row_never_touches_its_neighbours_and_a_row_alone_is_the_same() -> None:
    of, q = controller(), bent()
    state = stepped(of, q, target())
    good = of.look_ahead(state, target())
    spoilt = state._replace(ahead=state.ahead._replace(rate=state.ahead.rate.clone()))
    spoilt.ahead.rate[1] = torch.nan
    bad = of.look_ahead(spoilt, target())
    assert int(bad.ahead.next[1]) == AheadStatus.NOT_FINITE and (bad.ahead.knots[1] == 0.0).all()
    for row in (0, 2):
        assert torch.equal(bad.ahead.knots[row], good.ahead.knots[row])
        alone = of.look_ahead(mapped(lambda leaf, row=row: leaf[row] if leaf.dim() else leaf, state), target(row))
        torch.testing.assert_close(alone.ahead.knots, good.ahead.knots[row], rtol=1e-9, atol=1e-9)


def test_one_seed_is_one_way() -> None:
    q = bent()
    ways = [
        of.look_ahead(stepped(of, q, target()), target()).ahead.knots
        for of in (controller(), controller(), controller(seed=1))
    ]
    assert torch.equal(ways[0], ways[1]) and not torch.equal(ways[0], ways[2])


def test_machine_code_rolls_out_the_same() -> None:
    of, q = controller(spheres=((0.1, 0.0, -0.3, 0.05),)), bent()
    state = stepped(of, q, target())
    eager, compiled = (of.look_ahead(state, target(), of.rollouts(mode, 3)).ahead for mode in ("off", "aot"))
    torch.testing.assert_close(compiled.knots, eager.knots, rtol=1e-8, atol=1e-8)
    assert torch.equal(compiled.next, eager.next)


def test_the_law_that_ships_looks_ahead_too() -> None:
    of = controller(adaptation=ControlSettings().adaptation)
    state = stepped(of, bent(), target())
    looked = of.look_ahead(state, target())
    assert torch.isfinite(looked.ahead.knots).all() and (looked.ahead.next != AheadStatus.NOT_FINITE).all()


def test_what_cannot_look_ahead_is_refused() -> None:
    with pytest.raises(ConfigError, match=r"lookahead must be none where arm\.chambers are given: its rollouts are"):
        LookaheadController.for_arm(Arm(lengths=[0.2, 0.25], chambers=Chambers()), adaptation=None)
    with pytest.raises(ConfigError, match="lookahead must be none where model is not pcc"):
        LookaheadController.for_arm(ARM, adaptation=None, model=AffineBackbone.settings_type())
    with pytest.raises(ConfigError, match="differ from row to row: its rollouts have one model for all rows"):
        LookaheadController.for_arm(ARM, adaptation=None, null_gain=torch.tensor([0.1, 0.2]))
    with pytest.raises(ConfigError, match=r"spheres\[0\] must have a positive radius"):
        LookaheadSettings(spheres=((0.0, 0.0, 0.0, 0.0),))
    with pytest.raises(ConfigError, match=r"spheres\[1\] must be a list"):
        LookaheadSettings(spheres=((0.0, 0.0, 0.0, 0.1), 3.0))
