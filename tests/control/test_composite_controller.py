"""The controller with a model of the dynamics: its parts, what it leaves alone, and the loop on a matched arm."""

from __future__ import annotations

from typing import Any

import pytest
import torch
from torch import Tensor

from apcc_torch.control.adaptation import AdaptiveLaw
from apcc_torch.control.adaptive_dynamics import AdaptiveDynamics
from apcc_torch.control.composite_controller import CompositeController, CompositeState
from apcc_torch.control.controller import APCCController
from apcc_torch.control.inverse_kinematics import InverseKinematics
from apcc_torch.control.length_bounds import LengthBounds
from apcc_torch.control.pid import TendonPID, ramp
from apcc_torch.control.step_io import Measurement, Target
from apcc_torch.control.trajectory import SineTrajectory
from apcc_torch.errors import ConfigError, ShapeError, ValueRangeError
from apcc_torch.estimation.savitzky_golay import SavitzkyGolay
from apcc_torch.estimation.state_feedback import StateFeedback
from apcc_torch.model.abscissae import decouple
from apcc_torch.model.affine import AffineBackbone
from apcc_torch.model.backbone import PCCBackbone
from apcc_torch.model.dynamics import SoftArmDynamics
from apcc_torch.model.dynamics_regressor import DynamicsRegressor
from apcc_torch.model.stiffness import scaled_stiffness
from apcc_torch.model.tendons import rack_routing
from apcc_torch.native.compiled import compiled
from apcc_torch.native.function import NativeFunction
from apcc_torch.native.structure import flattened
from apcc_torch.simulation.dynamic import DynamicLog, DynamicSettings, simulate_dynamic
from apcc_torch.simulation.plant import Plant
from apcc_torch.simulation.sensors import PoseSensors
from arms import HANGING_BASE, PI, PI_HAT, configurations
from laws import bits, check_bad_row, generator, leaves, normal

D = torch.float64
RACKS = PI.cumsum(0)
ROUTING = rack_routing(RACKS)
TRUE = torch.tensor([0.0778, 10.0, 200.0, 0.25, 1.0], dtype=D)
DEVIATION = torch.tensor([0.02, 3.0, 50.0, 0.3, 0.0], dtype=D)


def kinematic(adaptive: bool = False, tendons: bool = True, **feedback: int) -> APCCController:
    backbone = PCCBackbone(3, HANGING_BASE)
    return APCCController(
        backbone,
        StateFeedback(backbone, RACKS, "pose", angular_weight=0.1, **feedback),
        SavitzkyGolay(window=5, order=2),
        InverseKinematics(1.8, null_gain=0.05),
        AdaptiveLaw(3, 0.5, rate=0.1),
        bounds=LengthBounds(PI, lower=0.75, upper=1.25, reach="free"),
        routing=ROUTING if tendons else None,
        adaptive=adaptive,
        elongation_bound=0.08,
    )


def composite(
    nominal: Tensor = TRUE,
    deviation: Tensor = DEVIATION,
    inner: APCCController | None = None,
    law: dict[str, Any] | None = None,
    **settings: Any,
) -> CompositeController:
    own = {"tracking_gain": 0.0, "filter_time": 0.1, "torque_noise": 0.05}
    learning = AdaptiveDynamics(nominal, deviation, **{**own, **(law or {})})
    regressor = DynamicsRegressor(ROUTING, HANGING_BASE)
    return CompositeController(inner or kinematic(), regressor, learning, **{"stiffness": 1.0, **settings})


def readings(rows: int, steps: int) -> list[tuple[Measurement, Target]]:
    """What the sensors of arms that move a little see, step by step."""
    rng, backbone = generator(1), PCCBackbone(3, HANGING_BASE)
    q = configurations((rows,), 3, D, rng, bend=0.6)
    x_d = backbone.tip(q, PI) + 0.05 * normal((rows, 3), D, rng)
    found = []
    for k in range(steps):
        T = backbone.pose((1.0 + 0.02 * k) * q, PI, *decouple(RACKS, PI))
        forces = normal((rows, 9), D, rng)
        stamp = torch.tensor(0.01 * (k + 1), dtype=D)
        found.append((Measurement(T, stamp, forces=forces), Target(x_d, torch.zeros_like(x_d))))
    return found


def same_bits(a: Any, b: Any) -> bool:
    return all(torch.equal(bits(x), bits(y)) for x, y in zip(leaves(a), leaves(b), strict=True))


@pytest.mark.parametrize("adaptive", [False, True])
def test_a_step_is_its_parts_and_the_kinematic_one_is_left_alone(adaptive: bool) -> None:
    c = composite(
        inner=kinematic(adaptive), stiffness=2.0, damping=0.3, reference_time=0.05, law={"tracking_gain": 0.5}
    )
    state = c.initial_state(torch.zeros(3, 9, dtype=D), PI_HAT)
    own, rate, estimate = state.kinematic, torch.zeros(3, 9, dtype=D), state.dynamics
    for measurement, target in readings(3, 4):
        before = own
        own, plain = c.kinematic(own, measurement, target)
        state, command = c(state, measurement, target)
        assert isinstance(state, CompositeState)
        assert same_bits(state.kinematic, own) and same_bits(command._replace(force=None), plain)
        dt = own.time - before.time
        asked = (own.q_d - before.q_d) / dt.unsqueeze(-1)
        moved = asked + (rate - asked) * torch.exp(-dt / 0.05).unsqueeze(-1)
        pairs = ((moved, rate), (own.qdot_bar, before.qdot_bar), (own.q_bar, before.q_bar))
        pull, swung, went = ((now - was) / dt.unsqueeze(-1) for now, was in pairs)
        rate, off = moved, own.q_bar - own.q_d
        v, a = rate - 2.0 * off, pull - 2.0 * (own.qdot_bar - rate)
        Y = c.dynamics(own.q_bar, own.qdot_bar, v, a, own.pi_hat, own.q_d)
        measured = c.dynamics(own.q_bar, own.qdot_bar, went, swung, own.pi_hat)
        B = ROUTING.matrix(own.pi_hat)
        assert measurement.forces is not None and command.force is not None
        s = own.qdot_bar - v
        estimate = c.law(estimate, Y, s, measured, (B @ measurement.forces.unsqueeze(-1)).squeeze(-1), dt)
        torch.testing.assert_close(state.theta_hat, estimate.theta_hat, rtol=1e-9, atol=1e-11)
        tau = (Y @ estimate.theta_hat.unsqueeze(-1)).squeeze(-1) - 0.3 * s
        # The forces of the tendons pull as was asked, but for the damping of the pseudo-inverse.
        torch.testing.assert_close((B @ command.force.unsqueeze(-1)).squeeze(-1), tau, rtol=1e-2, atol=1e-2)


def test_forces_are_bounded_and_bad_rows_stay_alone() -> None:
    c = composite(force_limit=0.5)
    (first, target), (second, _) = readings(4, 2)
    state, _ = c(c.initial_state(torch.zeros(4, 9, dtype=D), PI), first, target)
    _, command = c(state, second, target)
    assert command.force is not None and float(command.force.abs().max()) <= 0.5

    def step(T: Tensor, forces: Tensor, x_d: Tensor) -> tuple[Tensor, ...]:
        later, told = c(state, Measurement(T, second.time, forces=forces), Target(x_d, target.xdot_d))
        assert told.force is not None
        return later.q_bar, later.theta_hat, later.rate, told.force

    assert second.forces is not None
    check_bad_row(step, (second.T, second.forces, target.x_d))
    lost = second.T.clone()
    lost[1] = torch.nan
    assert all(bool(value.isfinite().all()) for value in step(lost, second.forces, target.x_d))


def test_without_forces_the_parameters_stay_and_the_feed_forward_goes_on() -> None:
    c = composite()
    (first, target), (second, _) = readings(2, 2)
    state, command = c(c.initial_state(torch.zeros(2, 9, dtype=D), PI), first._replace(forces=None), target)
    state, command = c(state, second._replace(forces=None), target)
    assert torch.equal(state.theta_hat, TRUE.expand(2, 5))
    assert command.force is not None and float(command.force.abs().min()) > 0.0
    with pytest.raises(ShapeError, match=r"measurement\.forces must have shape \(\.\.\., 9\)"):
        c(state, second._replace(forces=torch.zeros(2, 8, dtype=D)), target)


def test_the_tendon_loop_adds_the_feed_forward() -> None:
    pid, (z, y, ydot, y_d, force) = TendonPID(force_limit=40.0), normal((5, 9), D, generator(0)).unbind(0)
    plain = TendonPID()(z, 0.01 * y, ydot, 0.01 * y_d, ydot)
    torch.testing.assert_close(TendonPID()(z, 0.01 * y, ydot, 0.01 * y_d, ydot, force), plain + force)
    assert torch.equal(pid(z, y, ydot, y_d, ydot, 1e3 * force).abs(), torch.full((9,), 40.0, dtype=D))
    assert ramp(y, y_d, 0.5, 0.01).force is None and ramp(y, y_d, 0.5, 0.01, force).force is force


def matched(payload: Tensor) -> Plant:
    """The arm that is the model: three sections, their ends at the sensors."""
    axial, bending = scaled_stiffness(PI)
    arm = SoftArmDynamics(PI, PI / PI.sum(), axial, bending, 0.1, base_rotation=HANGING_BASE)
    return Plant(arm, ROUTING, TendonPID(), payload, 200.0, substeps=2, settle=1.5)


def followed(c: CompositeController | APCCController, duration: float, pace: float) -> DynamicLog:
    settings = DynamicSettings(duration=duration, control_rate=100.0)
    target = SineTrajectory(torch.tensor([0.0, 0.0, -0.5], dtype=D), torch.tensor([0.2, 0.2, 0.05], dtype=D), pace)
    with torch.inference_mode():
        plant = matched(TRUE[3:4])
        return simulate_dynamic(plant, c, PoseSensors(), target, PI, settings)


def test_on_the_arm_that_is_the_model_the_parameters_become_its_own() -> None:
    first = TRUE * torch.tensor([1.4, 0.7, 0.8, 0.0, 1.0], dtype=D)
    law = {"torque_noise": 0.02, "memory": 5.0, "filter_time": 0.3}
    log = followed(composite(first, law=law, pseudo_damping=1e-5), 1.5, 0.7)
    assert log.theta_hat.shape == (151, 1, 5) and torch.equal(log.theta_hat[0, 0], first)
    off = ((log.theta_hat[-1, 0] - TRUE) / TRUE).abs()
    assert float(off.max()) < 0.03 and float(off[4]) == 0.0


def test_a_feed_forward_that_knows_the_arm_keeps_it_on_q_d() -> None:
    exact = followed(composite(deviation=torch.zeros(5, dtype=D)), 0.6, 2.0)
    plain = followed(kinematic(), 0.6, 2.0)
    off, without = ((log.q_bar - log.q_d)[10:].norm(dim=-1).mean() for log in (exact, plain))
    assert float(off) < 0.2 * float(without)
    assert plain.theta_hat.shape == (61, 1, 0)


def test_a_step_as_machine_code_equals_its_eager_self() -> None:
    law = {"tracking_gain": 0.1, "dead_zone": 1e-3}
    c = composite(inner=kinematic(max_iterations=2), law=law, force_limit=80.0)
    with torch.no_grad():
        state = c.initial_state(torch.zeros(3, 9, dtype=D), PI.expand(3, 3), torch.zeros(3, dtype=D))
        given = readings(3, 3)
        target = given[0][1]
        blank = c.initial_state(torch.zeros(9, dtype=D), PI, torch.zeros((), dtype=D))
        first = given[0][0]
        one = first._replace(T=first.T[0], forces=torch.zeros(9, dtype=D))
        step = compiled(c, (blank, one, Target(target.x_d[0], target.xdot_d[0])), "aot", 3)
        assert isinstance(step, NativeFunction)
        for measurement, target in given:
            arguments = (state, measurement, target)
            state, command = c(*arguments)
            for have, want in zip(flattened(step(*arguments)), flattened((state, command)), strict=True):
                scale = want.double().abs().max().clamp(min=1.0)
                assert float((have.double() - want.double()).abs().max() / scale) < 1e-9


def test_settings_without_meaning_are_refused() -> None:
    for name, value in (("stiffness", -1.0), ("damping", float("inf")), ("reference_time", 0.0), ("force_limit", 0.0)):
        with pytest.raises(ValueRangeError, match=name):
            composite(**{name: value})
    law = AdaptiveDynamics(TRUE, DEVIATION)
    with pytest.raises(ConfigError, match="routing"):
        CompositeController(kinematic(tendons=False), DynamicsRegressor(ROUTING, HANGING_BASE), law)


def test_what_is_believed_is_told_by_settings() -> None:
    believed = {"bending_rigidity": 0.1, "axial_rigidity": 14.0, "tendon_damping": 30.0, "payload": 0.2, "mass": 0.9}
    deviations = {"bending_rigidity": 0.03, "axial_rigidity": 5.0, "tendon_damping": 10.0, "payload": 0.1, "mass": 0.0}
    learning = {"tracking_gain": 0.5, "filter_time": 0.2, "torque_noise": 0.07, "memory": 3.0, "dead_zone": 1e-3}
    nominal, deviation = (torch.tensor(list(each.values()), dtype=D) for each in (believed, deviations))
    motion = {"stiffness": 2.0, "damping": 0.1}
    uncertain = {f"{name}_deviation": value for name, value in deviations.items()}
    told = CompositeController(kinematic(), **believed, **uncertain, **learning, **motion)
    built = composite(nominal, deviation, law=learning, **motion)
    states = [c.initial_state(torch.zeros(2, 9, dtype=D), PI) for c in (told, built)]
    for measurement, target in readings(2, 3):
        (first, a), (second, b) = (c(s, measurement, target) for c, s in zip((told, built), states, strict=True))
        states = [first, second]
        assert same_bits(first, second) and same_bits(a, b)
    assert bool((states[0].theta_hat[:, :4] != nominal[:4]).any())
    # A feed-forward that learns nothing keeps what is believed.
    still = CompositeController(kinematic(), adapts=False, **believed, **uncertain, **learning, **motion)
    state = still.initial_state(torch.zeros(2, 9, dtype=D), PI)
    for measurement, target in readings(2, 3):
        state, command = still(state, measurement, target)
        assert torch.equal(state.theta_hat, nominal.expand(2, 5))
        assert command.force is not None and bool(command.force.any())
    bounded = CompositeController(kinematic(), lower=(0.01, 1.0, 0.0, 0.0, 0.5), upper=(1.0, 99.0, 900.0, 1.0, 2.0))
    assert bounded.law.lower.tolist() == [0.01, 1.0, 0.0, 0.0, 0.5] and bounded.law.upper[4] == 2.0
    with pytest.raises(ConfigError, match="upper must have 5 entries, got 2"):
        CompositeController(kinematic(), upper=(1.0, 2.0))


def test_a_model_of_other_sections_is_refused() -> None:
    backbone = AffineBackbone(3, HANGING_BASE)
    solver = InverseKinematics(coordinates=backbone.coordinates)
    inner = APCCController(backbone, StateFeedback(backbone, RACKS), SavitzkyGolay(5, 2), solver, routing=ROUTING)
    with pytest.raises(ConfigError, match="needs a model of constant-curvature sections"):
        CompositeController(inner)
