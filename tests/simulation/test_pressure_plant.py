"""The true arm under pressure: valves, rest, statics, and the closed loop."""

from __future__ import annotations

from math import exp

import pytest
import torch

from apcc_torch.control.controller import APCCController
from apcc_torch.control.pid import TendonReference
from apcc_torch.control.trajectory import SetPoint
from apcc_torch.errors import ConfigError
from apcc_torch.model.arm import Arm
from apcc_torch.model.statics import equilibrium
from apcc_torch.simulation.dynamic import ClosedLoop, DynamicSettings, simulate_dynamic
from apcc_torch.simulation.plant import Plant, PlantSettings
from apcc_torch.simulation.rod_plant import RodPlant, RodPlantSettings
from apcc_torch.simulation.sensors import PoseSensors
from apcc_torch.simulation.true_places import PlaceErrors
from apcc_torch.simulation.valves import Valves

TRUNK = Arm.load("soft_trunk")
NONE = torch.zeros(1, dtype=torch.float64)


def plant(**changes: float) -> Plant:
    return Plant.on(TRUNK, NONE, PlantSettings(**changes))


def test_a_valve_is_a_first_order_lag_at_any_step() -> None:
    valves = Valves.of(TRUNK)
    start, goal = valves.at_rest, torch.full((6,), 9e4).double()
    once = valves.after(start, goal, 0.03)
    often = start
    for _ in range(30):
        often = valves.after(often, goal, 0.001)
    torch.testing.assert_close(once, often)
    torch.testing.assert_close(once, goal + exp(-0.03 / 0.05) * (start - goal))
    assert (valves.after(start, 10.0 * goal, 100.0) - 1.2e5).abs().max() < 1e-6, "no command leaves its limits"
    with pytest.raises(ConfigError, match=r"arm\.chambers is null"):
        Valves.of(Arm(lengths=[0.2]))


def test_it_rests_where_the_statics_say() -> None:
    """From the pressures of rest and under others: K q + G = B u of the same finer arm, by Newton's method."""
    arm = plant()
    dynamics, routing, forces = arm.dynamics, arm.routing, Valves.of(TRUNK).forces
    p = torch.tensor([[2e4, 4e4, 1e4, 3e4, 1e4, 2e4]]).double()
    now, dt = arm.straight((1,)), 0.05
    told = TendonReference(now.z, now.z, pressure=p)
    for _ in range(150):
        now = arm.advance(now, told, dt, 0)
    expected = equilibrium(dynamics, routing=routing, tensions=-forces(p))
    torch.testing.assert_close(now.arm.q, expected.q, atol=1e-4, rtol=0.0)
    torch.testing.assert_close(now.held, p, rtol=1e-9, atol=1e-6)
    rest = arm.settled(6.0, dt)
    hanging = equilibrium(dynamics, routing=routing, tensions=torch.zeros_like(p))
    torch.testing.assert_close(rest.arm.q, hanging.q, atol=1e-4, rtol=0.0)


def test_chambers_have_neither_loop_nor_guides_nor_play() -> None:
    arm = plant(tendon_damping=300.0, backlash=0.01)
    assert arm.transmission is None and arm.tendon_damping == 0.0 and not arm.actuation_stiffness.any()
    assert not arm.actuation_damping.any() and arm.limp() is arm
    off = PlantSettings(places=PlaceErrors(tendons=0.001)).true_arm(TRUNK)
    assert off.chambers is not None and TRUNK.chambers is not None
    shift = torch.as_tensor(off.chambers.offsets) - torch.as_tensor(TRUNK.chambers.offsets)
    torch.testing.assert_close(shift, torch.full_like(shift, 0.001), atol=1e-7, rtol=0.0)


def test_a_plant_and_a_controller_that_do_not_fit_are_refused() -> None:
    tendons, target = Arm(lengths=[0.145, 0.145]), SetPoint(torch.zeros(1, 3).double())
    with pytest.raises(ConfigError, match="needs a controller that sets pressures"):
        ClosedLoop(plant(), APCCController.for_arm(tendons), PoseSensors(), target, 0.01)
    driven = Plant.on(tendons, NONE, PlantSettings())
    with pytest.raises(ConfigError, match="needs a controller that sets pressures"):
        ClosedLoop(driven, APCCController.for_arm(TRUNK), PoseSensors(), target, 0.01)


@pytest.mark.parametrize("kind", [Plant, RodPlant])
def test_the_closed_loop_comes_to_its_target(kind: type[Plant]) -> None:
    settings = (PlantSettings if kind is Plant else RodPlantSettings)(settle=0.5)
    arm = kind.on(TRUNK, NONE, settings)
    target = SetPoint(torch.tensor([[0.04, 0.03, -0.28]]).double())
    controller = APCCController.for_arm(TRUNK, K=1.5)
    run = DynamicSettings(duration=1.6, control_rate=25.0)
    log = simulate_dynamic(arm, controller, PoseSensors(), target, TRUNK.rest_lengths(), run)
    error = (log.x - log.x_d).norm(dim=-1)
    assert error[0] > 0.04 and error[-1] < 0.25 * error[0] and log.diverged_at.max() < 0
    assert log.pressure.shape == log.u.shape and log.pressure.min() >= 0.0 and log.pressure.max() <= 1.2e5
    torch.testing.assert_close(log.u, Valves.of(TRUNK).forces(log.pressure), atol=1e-9, rtol=1e-9)


def test_a_target_at_the_edge_is_approached_from_the_start() -> None:
    """The paper's named set-point in proportion to this arm: high and far, with its whole payload."""
    goal = torch.tensor([[0.325, 0.15, -0.275]]).double() * float(TRUNK.rest_lengths().sum()) / 0.6
    arm = Plant.on(TRUNK, torch.full((1,), 0.02).double(), PlantSettings(settle=0.5))
    controller = APCCController.for_arm(TRUNK, K=1.8, bend_bound=3.0, elongation_bound=0.039)
    run = DynamicSettings(duration=1.6, control_rate=25.0)
    log = simulate_dynamic(arm, controller, PoseSensors(), SetPoint(goal), TRUNK.rest_lengths(), run)
    error = (log.x - log.x_d).norm(dim=-1)
    assert error.max() <= error[0] + 1e-3 and error[-1] < 0.75 * error[0]
