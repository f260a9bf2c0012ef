"""One control step against its parts, in time, with sensors missing, and with nonsense in a row."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, NamedTuple

import pytest
import torch
from torch import Tensor
from torch.func import jacfwd

from apcc_torch.control.adaptation import AdaptiveLaw
from apcc_torch.control.controller import APCCController
from apcc_torch.control.inverse_kinematics import InverseKinematics
from apcc_torch.control.length_bounds import LengthBounds
from apcc_torch.control.length_law import LawStep, LengthLaw
from apcc_torch.control.step_io import Command, ControllerState, Measurement, Target
from apcc_torch.control.task_integral import TaskIntegral
from apcc_torch.control.tendon_limits import SolverStatus
from apcc_torch.errors import ConfigError, DtypeError, ShapeError, ValueRangeError
from apcc_torch.estimation.feedback import FeedbackStatus
from apcc_torch.estimation.pose_filter import PoseFilter
from apcc_torch.estimation.savitzky_golay import SavitzkyGolay
from apcc_torch.estimation.state_feedback import StateFeedback
from apcc_torch.lie import se3, so3
from apcc_torch.model.abscissae import decouple
from apcc_torch.model.backbone import PCCBackbone
from apcc_torch.model.tendons import TendonRouting, rack_routing
from apcc_torch.part import hold_rows
from apcc_torch.settings import Setting, Settings, aligned, resolved, setting
from arms import HANGING_BASE, PI, PI_HAT, configurations
from laws import bits, check_bad_row, generator, leaves, map_leaves, normal


def controller(
    regressor: str = "estimator_aware",
    mode: str = "pose",
    abscissae: Tensor | None = None,
    routing: TendonRouting | None = None,
    feedback: dict[str, Any] | None = None,
    **settings: Any,
) -> APCCController:
    backbone = PCCBackbone(3, HANGING_BASE)
    abscissae = PI.cumsum(0) if abscissae is None else abscissae
    return APCCController(
        backbone,
        StateFeedback(backbone, abscissae, mode, **(feedback or {})),
        SavitzkyGolay(window=5, order=2),
        InverseKinematics(K=1.5, null_gain=0.05),
        **{"laws": AdaptiveLaw(3, 0.5, regressor), "routing": routing, **settings},
    )


def scene(rows: int, seed: int = 0) -> tuple[Tensor, Tensor, Target]:
    """Configurations, the poses of sensors at the ends of the sections of V-A, and a target."""
    rng = generator(seed)
    q = configurations((rows,), 3, torch.float64, rng, bend=0.8)
    backbone = PCCBackbone(3, HANGING_BASE)
    T = backbone.pose(q, PI, *decouple(PI.cumsum(0), PI))
    x_d = backbone.tip(q, PI) + 0.05 * normal((rows, 3), torch.float64, rng)
    return q, T, Target(x_d, 0.1 * normal((rows, 3), torch.float64, rng))


def stamp(seconds: float, dtype: torch.dtype = torch.float64) -> Tensor:
    return torch.tensor(seconds, dtype=dtype)


def same_bits(a: Any, b: Any) -> bool:
    return all(torch.equal(bits(x), bits(y)) for x, y in zip(leaves(a), leaves(b), strict=True))


@pytest.mark.parametrize("velocity", ["measured", "commanded"])
@pytest.mark.parametrize("regressor", ["partial", "estimator_aware"])
def test_a_step_is_its_parts(regressor: str, velocity: str) -> None:
    q, _, target = scene(4)
    c = controller(regressor, velocity=velocity, routing=rack_routing(PI.cumsum(0)))
    state = c.initial_state(q + 0.05, PI_HAT)
    filtered = state.velocity_filter
    for k in range(1, 4):
        time = stamp(0.01 * k)
        T = c.backbone.pose((1.0 + 0.05 * k) * q, PI, *decouple(PI.cumsum(0), PI))
        later, command = c(state, Measurement(T, time), target)
        estimate = c.feedback(state.q_bar, state.pi_hat, T)
        filtered, qdot_bar = c.velocity_filter(filtered, estimate.q_bar, time.expand(4))
        e = target.x_d - T[:, -1, :3, 3]
        J_hat = c.backbone.tip_jacobian(estimate.q_bar, state.pi_hat)
        qdot = c.inverse_kinematics(J_hat, e, target.xdot_d, estimate.q_bar)
        q_d = state.q_d + 0.01 * qdot
        rate = qdot_bar if velocity == "measured" else qdot
        if regressor == "partial":
            Y = c.backbone.regressor(estimate.q_bar, rate)[0]
        else:
            Y = c.regressor(estimate.q_bar, rate, state.pi_hat, T=T)
        law = c.laws[0]
        assert isinstance(law, AdaptiveLaw)
        pi_hat = law(state.pi_hat, Y, e, stamp(0.01).expand(4))
        assert isinstance(later, ControllerState) and isinstance(command, Command)
        assert c.routing is not None and command.y is not None
        for have, want in (
            (command.feedback.q_bar, estimate.q_bar),
            (later.q_bar, estimate.q_bar),
            (later.qdot_bar, qdot_bar),
            (command.e, e),
            (command.qdot, qdot),
            (later.qdot, qdot),
            (command.q_d, q_d),
            (later.q_d, q_d),
            (later.pi_hat, pi_hat),
            (later.time, time.expand(4)),
            (command.y, c.routing.lengths(q_d, pi_hat)),
        ):
            torch.testing.assert_close(have, want, rtol=0, atol=1e-13)
        assert k == 1 or float((later.pi_hat - state.pi_hat).abs().min()) > 0.0
        state = later


def test_pure() -> None:
    q, T, target = scene(3)
    c = controller(routing=rack_routing(PI.cumsum(0)))
    state = c.initial_state(q, PI_HAT)
    state, _ = c(state, Measurement(T, stamp(0.01)), target)
    inputs = (state, Measurement(T, stamp(0.02)), target)
    before = map_leaves(torch.clone, inputs)
    first, again = c(*inputs), c(*inputs)
    assert same_bits(first, again)
    assert same_bits(inputs, before)
    # Nothing is kept in the module either: another arm in between changes nothing.
    c(c.initial_state(q + 0.3, PI), Measurement(T.flip(0), stamp(3.0)), target)
    assert same_bits(c(*inputs), first)


def test_standard_controller_keeps_its_parameters() -> None:
    q, T, target = scene(3)
    c = controller(adaptive=False)
    state = c.initial_state(q, PI_HAT)
    for k in range(1, 4):
        state, command = c(state, Measurement(T, stamp(0.02 * k)), target)
        assert torch.equal(state.pi_hat, PI_HAT.expand(3, 3))
    assert command.y is None
    assert float(state.q_d.sub(q).abs().max()) > 0.0


@dataclass(frozen=True, kw_only=True)
class LeakSettings(Settings):
    time: Setting = setting(2.0, "s", meaning="in which pi_hat returns", rows="number", above=0)


class Visits(NamedTuple):
    steps: Tensor


class Leak(LengthLaw):
    """A law of one's own: back to the first estimate, counting its steps."""

    settings_type = LeakSettings
    nominal: Tensor
    time: Setting

    def __init__(self, nominal: Tensor, *settings: Any, **changes: Any) -> None:
        super().__init__()
        hold_rows(self, nominal=(nominal, 1))
        self.hold(resolved(LeakSettings, settings, changes))

    def initial_memory(self, q: Tensor, pi_hat: Tensor) -> Visits:
        return Visits(torch.zeros_like(pi_hat[..., 0]))

    def speed(self, step: LawStep, memory: Visits) -> tuple[Tensor, Visits]:
        return (self.nominal - step.pi_hat) / aligned(self.time, 1), Visits(memory.steps + 1)


def test_the_speeds_of_laws_add_up_and_the_bounds_hold_for_their_sum() -> None:
    q, T, target = scene(3)
    gamma = torch.tensor([3.0, 0.2, 1.0], dtype=torch.float64)
    leak, law = Leak(0.3 * PI, time=0.05), AdaptiveLaw(3, gamma)
    bounds = LengthBounds(PI, PI.cumsum(0), lower=0.5, upper=1.1, reach="last")
    alone = [controller(laws=each) for each in (leak, law)]
    both = controller(laws=[leak, law], bounds=bounds)
    state = both.initial_state(q, PI_HAT)
    assert [memory is None for memory in state.memories] == [False, True]
    measurement = Measurement(T, stamp(0.04))
    later, _ = both(state, measurement, target)
    changes = [c(c.initial_state(q, PI_HAT), measurement, target)[0].pi_hat - PI_HAT for c in alone]
    moved = PI_HAT + changes[0] + changes[1]
    assert (moved.sum(-1) < PI.sum()).all()
    # The reach shares out what lacks as the gain of the law says that has one.
    torch.testing.assert_close(later.pi_hat, bounds(moved, torch.diag(gamma)), rtol=0, atol=1e-12)
    assert float((later.pi_hat - bounds(moved)).abs().max()) > 1e-4
    later, _ = both(later, Measurement(T, stamp(0.08)), target)
    assert later.memories[0].steps.tolist() == [2.0, 2.0, 2.0] and later.memories[1] is None


def test_without_a_law_nothing_adapts() -> None:
    q, T, target = scene(3)
    bounds = LengthBounds(PI, PI.cumsum(0), lower=0.99, upper=1.01, reach="last")
    for c in (controller(laws=()), controller(laws=[], bounds=bounds)):
        state, _ = c(c.initial_state(q, PI_HAT), Measurement(T, stamp(0.02)), target)
        assert torch.equal(state.pi_hat, PI_HAT.expand(3, 3)) and state.memories == ()


def test_a_law_s_numbers_may_differ_from_row_to_row() -> None:
    q, T, target = scene(3)
    times = torch.tensor([0.1, 0.5, 2.0], dtype=torch.float64)
    measurement = Measurement(T, stamp(0.02))
    together = controller(laws=Leak(PI, time=times))
    state, _ = together(together.initial_state(q, PI_HAT), measurement, target)
    for row in range(3):
        one = controller(laws=Leak(PI, time=float(times[row])))
        alone, _ = one(one.initial_state(q, PI_HAT), measurement, target)
        torch.testing.assert_close(state.pi_hat[row], alone.pi_hat[row], rtol=0, atol=1e-13)


def test_elapsed_time_is_the_difference_of_stamps() -> None:
    q, T, target = scene(3)
    c = controller(integration_limit=0.1)
    start = torch.tensor([100.0, 200.0, 300.0], dtype=torch.float64)
    state = c.initial_state(q, PI_HAT, start)
    elapsed = torch.zeros(3, dtype=torch.float64)
    # Uneven, none at all, a pause longer than the limit, and a stamp from the past.
    for step, counted in ((0.01, 0.01), (0.034, 0.034), (0.0, 0.0), (5.0, 0.1), (-1.0, 0.0)):
        elapsed = elapsed + step
        later, command = c(state, Measurement(T, start + elapsed), target)
        torch.testing.assert_close(later.q_d, state.q_d + counted * command.qdot, rtol=0, atol=1e-12)
        assert torch.equal(later.time, start + elapsed)
        state = later
    assert torch.isfinite(state.pi_hat).all()


def test_velocity_filter_sees_the_estimates_and_their_stamps() -> None:
    backbone = PCCBackbone(3, HANGING_BASE)
    q, _, target = scene(2)
    rate = normal((2, 9), torch.float64, generator(1)) * torch.tensor([0.3, 0.3, 0.01] * 3, dtype=torch.float64)
    c = controller(feedback={"linear_threshold": 1e-10, "angular_threshold": 1e-10}, adaptive=False)
    state = c.initial_state(q, PI)
    for time in (0.01, 0.02, 0.05, 0.06, 0.08, 0.09):
        moved = q + time * rate
        T = backbone.pose(moved, PI, *decouple(PI.cumsum(0), PI))
        state, _ = c(state, Measurement(T, stamp(time)), target)
        torch.testing.assert_close(state.q_bar, moved, rtol=0, atol=1e-9)
    torch.testing.assert_close(state.qdot_bar, rate, rtol=0, atol=1e-6)
    assert state.velocity_filter.valid.all()
    torch.testing.assert_close(state.velocity_filter.times[0], torch.tensor([0.02, 0.05, 0.06, 0.08, 0.09]).double())


def test_measured_tip_and_its_absence() -> None:
    q, T, target = scene(4)
    c = controller()
    state = c.initial_state(q, PI_HAT)

    def error(measurement: Measurement) -> tuple[Tensor, Tensor]:
        _, command = c(state, measurement, target)
        return command.e, target.x_d - c.backbone.tip(command.feedback.q_bar, PI_HAT)

    seen = target.x_d - T[:, -1, :3, 3]
    e, model = error(Measurement(T, stamp(0.01)))
    assert torch.equal(e, seen) and float((seen - model).norm(dim=-1).min()) > 1e-4
    mask = torch.ones(4, 3, dtype=torch.bool)
    mask[1, 2] = False
    e, model = error(Measurement(T, stamp(0.01), mask))
    assert torch.equal(e[[0, 2, 3]], seen[[0, 2, 3]]) and torch.equal(e[1], model[1])
    gap = T.clone()
    gap[2, 2, 1, 3] = torch.nan
    e, model = error(Measurement(gap, stamp(0.01)))
    assert torch.equal(e[[0, 1, 3]], seen[[0, 1, 3]]) and torch.equal(e[2], model[2])
    # A tip sensor of its own comes first, whatever the last sensor of the arm says.
    tip = T[:, -1, :3, 3] + 0.01
    tip[3] = torch.nan
    e, model = error(Measurement(T, stamp(0.01), mask, tip=tip))
    assert torch.equal(e[:3], (target.x_d - tip)[:3]) and torch.equal(e[3], model[3])


def test_all_sensors_lost() -> None:
    q, T, target = scene(2)
    c = controller()
    state, _ = c(c.initial_state(q, PI_HAT), Measurement(T, stamp(0.01)), target)
    later, command = c(state, Measurement(torch.full_like(T, torch.nan), stamp(0.02)), target)
    assert (command.feedback.status == FeedbackStatus.INVALID).all()
    assert torch.equal(later.q_bar, state.q_bar)
    assert all(torch.isfinite(leaf).all() for leaf in leaves((later, command)))


@pytest.mark.parametrize("own_tip", [False, True])
def test_a_row_without_an_estimate_holds_its_command(own_tip: bool) -> None:
    q, T, target = scene(3)
    c = controller(routing=rack_routing(PI.cumsum(0)), integral=TaskIntegral(gain=1.0))
    tip = T[:, -1, :3, 3] + 0.01 if own_tip else None
    state, first = c(c.initial_state(q, PI_HAT), Measurement(T, stamp(0.01), tip=tip), target)
    want = c(state, Measurement(T, stamp(0.02), tip=tip), target)
    bad = T.clone()
    bad[1, 2] = 0.0
    later, command = have = c(state, Measurement(bad, stamp(0.02), tip=tip), target)
    assert (command.feedback.status == FeedbackStatus.INVALID).tolist() == [False, True, False]
    for name in ("q_bar", "q_d", "pi_hat", "integral"):
        assert torch.equal(getattr(later, name)[1], getattr(state, name)[1]), name
    assert command.y is not None and torch.equal(command.qdot[1], torch.zeros(9).double())
    assert torch.equal(command.y[1], c.tendons(state.q_d, state.pi_hat)[1])
    assert float((first.y - command.y)[1].abs().max()) < 1e-12
    for now, was in zip(leaves(have), leaves(want), strict=True):
        assert torch.equal(bits(now[[0, 2]]), bits(was[[0, 2]])) if now.dim() and len(now) == 3 else True


def test_bounds() -> None:
    q, T, target = scene(20)
    q = q * 1.5
    c = controller(bend_bound=0.5, elongation_bound=4e-3, integration_limit=10.0)
    state, command = c(c.initial_state(q, PI_HAT), Measurement(T, stamp(0.5)), target)
    free = (q + 0.5 * command.qdot).unflatten(-1, (3, 3))
    held = state.q_d.unflatten(-1, (3, 3))
    torch.testing.assert_close(held[..., :2], free[..., :2].clamp(-0.5, 0.5))
    torch.testing.assert_close(held[..., 2], free[..., 2].clamp(-4e-3, 4e-3))
    assert float(free[..., :2].abs().max()) > 0.5 and float(free[..., 2].abs().max()) > 4e-3


def test_bad_rows_leave_their_neighbours() -> None:
    q, T, target = scene(4)
    c = controller(routing=rack_routing(PI.cumsum(0)), bend_bound=2.0)
    state = c.initial_state(q, PI_HAT.expand(4, 3))
    state, _ = c(state, Measurement(T, stamp(0.01)), target)
    tip = T[:, -1, :3, 3].clone()
    measurement = Measurement(T, stamp(0.02).expand(4), None, None, tip)
    check_bad_row(c, (state, measurement, target))


@pytest.mark.parametrize("compiled", [False, True], ids=["eager", "compiled"])
def test_a_target_that_is_not_finite_holds_its_row_and_no_other(compiled: bool) -> None:
    q, T, target = scene(4)
    c = controller(routing=rack_routing(PI.cumsum(0)), integral=TaskIntegral(gain=0.5), feedback={"max_iterations": 1})
    step = torch.compile(c, fullgraph=True, backend="aot_eager") if compiled else c
    state, _ = c(c.initial_state(q, PI_HAT.expand(4, 3)), Measurement(T, stamp(0.01)), target)
    measurement = Measurement(T, stamp(0.02))
    with torch.no_grad():
        want, wanted = step(state, measurement, target)
        assert wanted.limits.tolist() == [SolverStatus.FREE] * 4
        for have, eager in zip(leaves((want, wanted)), leaves(c(state, measurement, target)), strict=True):
            torch.testing.assert_close(have, eager, rtol=0, atol=1e-12)
        for name, bad in (("x_d", torch.nan), ("x_d", torch.inf), ("xdot_d", torch.nan), ("xdot_d", -torch.inf)):
            field = getattr(target, name).clone()
            field[2, 1] = bad
            later, command = step(state, measurement, target._replace(**{name: field}))
            assert torch.equal(later.q_d[2], state.q_d[2]) and not command.qdot[2].any()
            assert command.limits.tolist() == [0, 0, SolverStatus.NOT_FINITE, 0]
            assert all(torch.isfinite(leaf[2]).all() for leaf in leaves(later) if leaf.dim() and len(leaf) == 4)
            others = [0, 1, 3]
            for a, b in zip(leaves((later, command)), leaves((want, wanted)), strict=True):
                if a.dim() and len(a) == 4:
                    assert torch.equal(bits(a[others]), bits(b[others]))


def test_nonsense_does_not_stay() -> None:
    q, T, target = scene(2)
    c = controller()
    state, _ = c(c.initial_state(q, PI_HAT), Measurement(T, stamp(0.01)), target)
    for bad in (torch.nan, torch.inf):
        for broken in (
            (Measurement(T, stamp(0.02)), Target(target.x_d + bad, target.xdot_d)),
            (Measurement(T, stamp(0.02)), Target(target.x_d, target.xdot_d * bad)),
            (Measurement(T * bad, stamp(0.02)), target),
            (Measurement(T, stamp(0.02), tip=T[:, -1, :3, 3] * bad), target),
        ):
            later, _ = c(state, *broken)
            for name in ("q_bar", "pi_hat", "q_d"):
                assert torch.isfinite(getattr(later, name)).all(), name
            later, command = c(later, Measurement(T, stamp(0.03)), target)
            assert all(torch.isfinite(leaf).all() for leaf in leaves((later, command)))


@pytest.mark.parametrize("stamps", [torch.float32, torch.float64])
def test_single_precision(stamps: torch.dtype) -> None:
    q, T, target = scene(3)
    c = controller(routing=rack_routing(PI.cumsum(0))).to(torch.float32)
    double = controller(routing=rack_routing(PI.cumsum(0)))
    single = Target(target.x_d.float(), target.xdot_d.float())
    # A clock that has run for weeks: its stamps need double precision, the arm does not.
    begin = 0.0 if stamps == torch.float32 else 3e6
    state = c.initial_state(q.float(), PI_HAT.float(), stamp(begin, stamps))
    wanted = double.initial_state(q, PI_HAT, stamp(begin))
    for k in range(1, 6):
        state, command = c(state, Measurement(T.float(), stamp(begin + 0.01 * k, stamps)), single)
        wanted, want = double(wanted, Measurement(T, stamp(begin + 0.01 * k)), target)
        for part in (state.q_bar, state.qdot_bar, state.pi_hat, state.q_d, command.qdot, command.e, command.y):
            assert part is not None and part.dtype == torch.float32
        torch.testing.assert_close(command.q_d.double(), want.q_d, rtol=1e-4, atol=1e-4)
        torch.testing.assert_close(state.pi_hat.double(), wanted.pi_hat, rtol=1e-3, atol=1e-4)
    assert state.time.dtype == stamps


@pytest.mark.parametrize("mode", ["position", "pose"])
def test_total_regressor(mode: str) -> None:
    # Sensors inside the arm, so that they slide along the model as its parameters change.
    X = torch.tensor([0.09, 0.33, 0.58], dtype=torch.float64)
    weight = 0.4
    tight = {"linear_threshold": 1e-15, "angular_threshold": 1e-15, "max_iterations": 60, "settled_step": 1e-13}
    c = controller(mode=mode, abscissae=X, feedback={"angular_weight": weight, **tight})
    backbone = c.backbone
    for seed in range(3):
        rng = generator(seed)
        q, qdot = configurations((), 3, torch.float64, rng, bend=0.9), normal((9,), torch.float64, rng)
        T = backbone.pose(q, PI, *decouple(X, PI))

        def gap(q_bar: Tensor, pi: Tensor, T: Tensor = T) -> Tensor:
            between = se3.inverse(T) @ backbone.pose(q_bar, pi, *decouple(X, pi))
            linear, angular = between[:, :3, 3], so3.vee(between[:, :3, :3])
            return (linear if mode == "position" else torch.cat((linear, weight * angular))).flatten()

        def velocity(q_bar: Tensor, pi: Tensor, qdot: Tensor = qdot) -> Tensor:
            return jacfwd(backbone.tip)(q_bar, pi) @ qdot

        q_bar_slope = -torch.linalg.lstsq(jacfwd(gap)(q, PI), jacfwd(gap, argnums=1)(q, PI)).solution
        want = jacfwd(velocity, argnums=1)(q, PI) + jacfwd(velocity)(q, PI) @ q_bar_slope
        scale = float(want.abs().max())
        have = c.regressor(q, qdot, PI)
        torch.testing.assert_close(have, want, rtol=0, atol=1e-4 * scale)
        # The whole of it, through the estimator itself.
        h = 1e-5
        steps = h * torch.eye(3, dtype=torch.float64)
        ahead, behind = (
            (backbone.tip_jacobian(c.feedback(q, PI + s * steps, T).q_bar, PI + s * steps) @ qdot) for s in (1.0, -1.0)
        )
        torch.testing.assert_close((ahead - behind).mT / (2 * h), want, rtol=0, atol=2e-4 * scale)
        assert float((have - backbone.regressor(q, qdot)[0]).abs().max()) > 0.05 * scale
        # Of a controller whose law takes theorem 1's, it is the total one all the same.
        assert torch.equal(
            controller("partial", mode, X, feedback={"angular_weight": weight, **tight}).regressor(q, qdot, PI), have
        )


def test_regressor_knows_which_sensors_the_estimate_used() -> None:
    X = torch.tensor([0.09, 0.33, 0.5, 0.58], dtype=torch.float64)
    q, _, target = scene(3)
    full, fewer = controller(abscissae=X), controller(abscissae=X[[0, 1, 3]])
    T = full.backbone.pose(q, PI, *decouple(X, PI))
    mask = torch.tensor([True, True, False, True])
    lost = T.clone()
    lost[:, 2] = torch.nan
    rates = []
    for c, poses, seen in ((fewer, T[:, mask], None), (full, T, mask), (full, lost, None)):
        state = c.initial_state(q, PI_HAT)
        for k in range(1, 4):
            state, _ = c(state, Measurement(poses, stamp(0.01 * k), seen), target)
        rates.append(state.pi_hat)
    torch.testing.assert_close(rates[1], rates[0], rtol=0, atol=1e-9)
    assert torch.equal(rates[2], rates[1])


def test_shapes_follow_the_largest_batch() -> None:
    q, T, target = scene(1)
    c = controller()
    one = map_leaves(lambda leaf: leaf[0], (T, target))
    state, command = c(c.initial_state(q[0], PI_HAT), Measurement(one[0], stamp(0.01)), one[1])
    assert command.q_d.shape == (9,) and state.time.shape == ()
    # One measurement for a batch of parameters.
    lengths = PI_HAT + torch.tensor([[0.0], [1e-3]], dtype=torch.float64)
    both, command = c(c.initial_state(q[0], lengths), Measurement(one[0], stamp(0.01)), one[1])
    assert command.q_d.shape == (2, 9)
    torch.testing.assert_close(both.pi_hat[0], state.pi_hat)


def test_one_arm_and_many_targets() -> None:
    q, T, target = scene(4)
    for regressor in ("partial", "estimator_aware"):
        c = controller(regressor, velocity="commanded")
        measurement = Measurement(T[0], stamp(0.01))
        many, command = c(c.initial_state(q[0], PI_HAT), measurement, target)
        assert command.qdot.shape == (4, 9) and many.pi_hat.shape == (4, 3)
        for row in range(4):
            one, _ = c(c.initial_state(q[0], PI_HAT), measurement, Target(target.x_d[row], target.xdot_d[row]))
            torch.testing.assert_close(many.pi_hat[row], one.pi_hat, rtol=0, atol=1e-12)
            torch.testing.assert_close(many.q_d[row], one.q_d, rtol=0, atol=1e-12)


def test_refusals() -> None:
    with pytest.raises(ConfigError, match="velocity must be one of measured, commanded"):
        controller(velocity="filtered")
    for name in ("bend_bound", "elongation_bound", "integration_limit"):
        for value in (0.0, -1.0, float("nan"), float("inf")):
            with pytest.raises(ValueRangeError, match=name):
                controller(**{name: value})
    c = controller()
    q, T, target = scene(2)
    state = c.initial_state(q, PI_HAT)
    time = stamp(0.01)
    with pytest.raises(ShapeError, match="L0 must have shape"):
        c.initial_state(q, PI_HAT[:2])
    for measurement, wanted, error, message in (
        (Measurement(T[:, :2], time), target, ShapeError, r"T must have shape \(\.\.\., 3, 4, 4\)"),
        (Measurement(T[..., 0], time), target, ShapeError, r"measurement\.T must have shape"),
        (Measurement(T.float(), time), target, DtypeError, r"measurement\.T is torch\.float32"),
        (Measurement(T, time.long()), target, DtypeError, r"measurement\.time must be a floating-point"),
        (Measurement(T, time.expand(3)), target, ShapeError, r"measurement\.time \(3,\)"),
        (Measurement(T, time, torch.ones(2, 2, dtype=torch.bool)), target, ShapeError, "mask must have shape"),
        (Measurement(T, time, tip=T[..., 3]), target, ShapeError, r"measurement\.tip must have shape"),
        (Measurement(T, time), Target(target.x_d[:, :2], target.xdot_d), ShapeError, r"target\.x_d must have shape"),
        (Measurement(T, time), Target(target.x_d, target.xdot_d[:, :2]), ShapeError, r"target\.xdot_d must have shape"),
        (Measurement(T, time), Target(target.x_d.float(), target.xdot_d), DtypeError, r"target\.x_d is torch\.float32"),
        (Measurement(T, time), Target(target.x_d.expand(3, 2, 3)[:, :1].expand(3, 5, 3), target.xdot_d), ShapeError,
         "do not broadcast"),
    ):  # fmt: skip
        with pytest.raises(error, match=message):
            c(state, measurement, wanted)


def test_the_pose_filter_is_before_algorithm_2_and_the_integral_beside_the_error() -> None:
    q, T, target = scene(4)
    c = controller(pose_filter=PoseFilter(0.1, 0.05, delay=1), integral=TaskIntegral(0.8, reach=0.1))
    assert c.pose_filter is not None and c.integral is not None
    state = c.initial_state(q + 0.05, PI_HAT)
    expected, z, usable = state.expected, torch.zeros(4, 3, dtype=torch.float64), torch.ones(4, 3, dtype=torch.bool)
    assert expected is not None
    for k in range(1, 4):
        T = c.backbone.pose((1.0 + 0.05 * k) * q, PI, *decouple(PI.cumsum(0), PI))
        later, command = c(state, Measurement(T, stamp(0.01 * k)), target)
        expected, seen = c.pose_filter(expected, T, usable, usable, stamp(0.01))
        estimate = c.feedback(state.q_bar, state.pi_hat, seen)
        e = target.x_d - T[:, -1, :3, 3]
        z = c.integral(z, e, stamp(0.01))
        J_hat = c.backbone.tip_jacobian(estimate.q_bar, state.pi_hat)
        qdot = c.inverse_kinematics(J_hat, e + z, target.xdot_d, estimate.q_bar)
        pi_hat = state.pi_hat
        points = c.backbone.material_points(pi_hat, *decouple(PI.cumsum(0).expand(4, 3), pi_hat))
        expected = c.pose_filter.moved(expected, c.backbone, points, estimate.q_bar, 0.01 * qdot)
        assert later.expected is not None and later.integral is not None
        for have, want in (
            (command.e, e),
            (command.qdot, qdot),
            (command.feedback.q_bar, estimate.q_bar),
            (later.integral, z),
            (later.expected.T, expected.T),
            (later.expected.age, expected.age),
        ):
            torch.testing.assert_close(have, want, rtol=0, atol=1e-12)
        state = later


def test_a_tip_that_is_not_seen_is_not_integrated() -> None:
    q, T, target = scene(3)
    c = controller(integral=TaskIntegral(0.8, reach=1.0), pose_filter=PoseFilter(0.1))
    state = c.initial_state(q, PI_HAT)
    state, _ = c(state, Measurement(T, stamp(0.01)), target)
    mask = torch.ones(3, 3, dtype=torch.bool)
    mask[1, -1] = False
    later, command = c(state, Measurement(T, stamp(0.02), mask), target)
    assert state.integral is not None and later.integral is not None
    assert torch.equal(later.integral[1], state.integral[1])
    assert bool((later.integral[[0, 2]] != state.integral[[0, 2]]).any(-1).all())
    assert bool(command.q_d.isfinite().all())
