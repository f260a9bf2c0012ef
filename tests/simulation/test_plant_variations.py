"""What differs on the true arm, or happens to it in a run: against statics, loops worked by hand, other plants."""

from __future__ import annotations

from typing import Any

import pytest
import torch
from torch import Tensor

from apcc_torch.composed import compose
from apcc_torch.composition.build import Builder
from apcc_torch.control.pid import TendonReference, ramp
from apcc_torch.envs.dynamic import DynamicArm
from apcc_torch.errors import ConfigError, ValueRangeError
from apcc_torch.model.arm import Arm
from apcc_torch.model.statics import equilibrium
from apcc_torch.native.compiled import compiled
from apcc_torch.simulation.events import ArmEvents
from apcc_torch.simulation.plant import Plant, PlantSettings, PlantStep
from apcc_torch.simulation.rod_plant import RodPlant
from arm_rows import row_parameters
from true_arms import ARM, D, numbers, plant, run, tip

ALL = {
    "backlash": 2e-3,
    "places": {"tendons": 3e-3},
    "events": {"taken": 0.1, "taken_at": 0.02, "growth": [0.1, -0.05], "growth_over": 0.04},
}
"""All that can be told of a plant, within its first 0.05 s."""


def test_a_load_is_there_from_its_time_on() -> None:
    y = torch.zeros(3, 6, dtype=D)
    taking = plant(numbers(0.1, 0.3, 0.2), events={"taken": numbers(0.2, -0.1, -9.0), "taken_at": 0.05})
    before, after = plant(numbers(0.1, 0.3, 0.2)), plant(numbers(0.3, 0.2, 0.0))
    now = run(before, y, 5, 0.01)
    torch.testing.assert_close(run(taking, y, 5, 0.01), now, rtol=0, atol=0)
    for k in range(5):
        now = after.advance(now, TendonReference(y, y), 0.01, k)
    later = run(taking, y, 5, 0.01)
    for k in range(5):
        later = taking.advance(later, TendonReference(y, y), 0.01, k)
    torch.testing.assert_close(later.arm, now.arm, rtol=0, atol=1e-15)
    # Nothing happens before the clock starts, however long the arm settles.
    assert taking.settled(0.2, 0.01).time.tolist() == [0.0, 0.0, 0.0]
    torch.testing.assert_close(taking.settled(0.2, 0.01).arm, before.settled(0.2, 0.01).arm, rtol=0, atol=1e-15)


@pytest.mark.parametrize("kind", [Plant, RodPlant])
def test_a_grown_arm_rests_as_one_made_longer(kind: type[Plant]) -> None:
    """Loose tendons; the arm that is made so has the same masses and springs at other rest lengths."""
    growth = numbers(0.05, 0.2)
    loose = PlantSettings().pid.changed(K_P=0.0, K_I=0.0, K_D=0.0)
    payload = numbers(0.2)
    leaning = ARM.changed(placement=ARM.placement.changed(gravity=(2.0, 1.0, -9.0)))
    grown = plant(payload, kind, leaning, pid=loose, events={"growth": growth, "growth_from": 0.1, "growth_over": 0.5})
    made = grown.dynamics
    longer = {name: getattr(made, name) for name in ("masses", *set(made.springs))} | {
        "gravity": made.gravity_acceleration
    }
    if kind is RodPlant:
        longer["radius"] = numbers(0.027)[0]
    other = type(made)(made.lengths * (1.0 + growth), base_rotation=made.base_rotation, **longer)
    want = equilibrium(other, payload=payload)
    end = other.kinematics().tip(want.q, other.lengths)
    # Told by elongations of the lengths of before, it is what their springs hold at other natural lengths.
    axial = made.axial_stiffness * growth * made.lengths
    same = equilibrium(made, tau=grown.backbone.coordinates.on_elongations(axial), payload=payload)
    # A rod's two small corrections know the lengths of before.
    off = (grown.backbone.tip(same.q, made.lengths) - end).norm()
    assert float(off) < (1e-8 if kind is Plant else 2e-3)
    y = torch.zeros(1, 6, dtype=D)
    speeds = []
    for arm in (grown, plant(payload, kind, leaning, pid=loose)):
        now = arm.straight((1,))
        now = now._replace(arm=now.arm._replace(q=same.q), time=now.time + 1.0)
        speeds.append(float(arm.advance(now, TendonReference(y, y), 0.01, 0).arm.qdot.abs().max()))
    assert speeds[0] < 1e-8 and speeds[1] > 1e-3
    half = grown.events.growth_at(numbers(0.35))
    torch.testing.assert_close(half, 0.5 * growth.expand(1, 2))


def test_backlash_draws_its_loop() -> None:
    """Play of 2 mm, worked by hand: the tendon follows 1 mm behind its motor, and waits 2 mm at each turn."""
    floating = ARM.changed(placement=ARM.placement.changed(gravity=(0.0, 0.0, 0.0)))
    arm = plant(numbers(0.0), arm=floating, backlash=2e-3)
    motor = numbers(0.5, 0.9, 2.0, 4.0, 3.0, 2.0, 1.0, -1.0, -4.0, -3.0, -2.0, 0.0, 4.0)
    tendon = numbers(0.0, 0.0, 1.0, 3.0, 3.0, 3.0, 2.0, 0.0, -3.0, -3.0, -3.0, -1.0, 3.0)
    now, found, before = arm.straight((1,)), [], torch.zeros(1, 6, dtype=D)
    for at in 1e-3 * motor:
        y = at.expand(1, 6)
        reference = TendonReference(y, (y - before) / 0.01)
        u = arm.forces(now, reference)
        now, before = arm.step(now, reference, 0.01), y
        found.append(now.held[0, 0])
        if len(found) < 3:
            assert not bool(u.any()), "within its play a motor does not pull"
    torch.testing.assert_close(1e3 * torch.stack(found), tendon)
    # The loop's area, play times the way between its ends, is what a cycle loses per unit of force.
    cycle = torch.tensor([4, 3, 2, 1, -1, -4, -3, -2, 0, 4], dtype=D), tendon[3:]
    area = torch.trapezoid(cycle[1], cycle[0]).abs()
    assert 0.5 * 2.0 * 6.0 < float(area) < 2.0 * 8.0


def test_the_arm_feels_the_backlash() -> None:
    tight, loose = plant(numbers(0.0)), plant(numbers(0.0), backlash=4e-3)
    y = numbers(-0.02, 0.01, 0.01, 0.0, 0.0, 0.0).expand(1, 6)
    with torch.inference_mode():
        ends = [arm.lengths(run(arm, y, 60, 0.02).arm.q) for arm in (tight, loose)]
        less = tight.lengths(run(tight, y.sign() * (y.abs() - 2e-3).clamp(min=0), 60, 0.02).arm.q)
    assert float((ends[0] - ends[1]).abs().max()) > 1e-3
    torch.testing.assert_close(ends[1], less, rtol=0, atol=2e-4)


def test_sensors_and_tendons_are_where_they_are_not_believed_to_be() -> None:
    words = ("experiment=dynamic_run_2", "plant.places.sensors=-0.01", "plant.places.tendons=0.002")
    composed = compose(*words)
    build = Builder(composed.settings)
    torch.testing.assert_close(build.true_sensors_at(), build.sensors_at() - 0.01)
    assert build.arm.tendon_offset == 0.027 and build.true_arm.tendon_offset == pytest.approx(0.029)
    believed, true = compose("experiment=dynamic_run_2").plant().B, composed.plant().B
    bends, stretch = (slice(0, None, 3), slice(2, None, 3))
    torch.testing.assert_close(true[bends], believed[bends] * 29.0 / 27.0)
    torch.testing.assert_close(true[stretch], believed[stretch])
    told = Arm(lengths=[0.2, 0.25], tendons=ARM.tendons.changed(offsets=0.02))
    torch.testing.assert_close(
        PlantSettings().places.changed(tendons=-0.005).on(told).routing().offsets, 0.015 * torch.ones(6).double()
    )
    for words, match in (("sensors=0.01", "sensors must leave"), ("tendons=-0.03", "tendons must leave")):
        with pytest.raises(ValueRangeError, match=f"^plant.places.{match}"):
            compose("experiment=dynamic_run_2", f"plant.places.{words}")


def test_growth_has_an_entry_for_each_section_or_for_runs_of_them() -> None:
    time = numbers(10.0)
    assert ArmEvents(4, growth=["along", 0.0, 0.2]).growth_at(time)[0].tolist() == pytest.approx([0.0, 0.05, 0.15, 0.2])
    assert ArmEvents(4, growth=[0.1, 0.2]).growth_at(time)[0].tolist() == pytest.approx([0.1, 0.1, 0.2, 0.2])
    with pytest.raises(ConfigError, match="growth must have one entry"):
        ArmEvents(4, growth=[0.1, 0.2, 0.3])


@pytest.mark.parametrize("kind", [Plant, RodPlant])
def test_rows_may_differ_in_all_of_it(kind: type[Plant]) -> None:
    backlash, offset, taken, at = numbers(0.0, 2e-3, 4e-3), numbers(-2e-3, 0.0, 3e-3), numbers(0.0, 0.1, -0.1), 0.02
    growth, begin, over = numbers(0.0, 0.1, -0.1), numbers(0.0, 0.01, 0.02), numbers(0.05, 0.02, 0.01)
    y = 0.02 * torch.cos(torch.arange(18, dtype=D)).view(3, 6)
    payload = numbers(0.1, 0.2, 0.3)

    def made(i: Any, payload: Tensor) -> Plant:
        number = (lambda values: values) if i is None else (lambda values: float(values[i]))
        grown = torch.stack((growth, -growth), -1) if i is None else [float(growth[i]), -float(growth[i])]
        events = {
            "taken": number(taken), "taken_at": at, "growth": grown,
            "growth_from": number(begin), "growth_over": number(over),
        }  # fmt: skip
        places = {"tendons": number(offset)}
        return plant(payload, kind, backlash=number(backlash), events=events, places=places)

    together = run(made(None, payload), y, 6, 0.01)
    for i in range(3):
        alone = run(made(i, payload[i : i + 1]), y[i : i + 1], 6, 0.01)
        torch.testing.assert_close(together.arm.q[i : i + 1], alone.arm.q, rtol=0, atol=1e-12)
        torch.testing.assert_close(together.held[i : i + 1], alone.held, rtol=0, atol=1e-12)


def test_compiled_plants_have_times_for_inputs() -> None:
    """One library, built before anything happens, steps through all of it; rows of one batch differ in it."""
    one = Arm(lengths=[0.2], mass=0.4)
    events = {"taken": numbers(0.1, 0.3), "taken_at": numbers(0.02, 0.03), "growth": 0.1, "growth_over": 0.05}
    arm = plant(numbers(0.1, 0.2), RodPlant, one, backlash=1e-3, events=events)
    step = PlantStep(arm, 0.01)
    native = compiled(step, step.blank(), "aot", 2)
    y = numbers(-0.02, 0.01, 0.01).expand(2, 3)
    now = eager = arm.straight((2,))
    for k in range(1, 7):
        reference = ramp(torch.zeros_like(y), y, k / 6, 0.06)
        now, eager = native(now, reference), step(eager, reference)
    torch.testing.assert_close(now.arm, eager.arm, rtol=0, atol=1e-11)
    torch.testing.assert_close(now.held, eager.held, rtol=0, atol=1e-15)
    still = run(plant(numbers(0.1, 0.2), RodPlant, one), y, 6, 0.01)
    assert float((tip(arm, now) - tip(arm, still)).norm(dim=-1).min()) > 1e-4


def test_environments_have_the_same_plants() -> None:
    kind = {"kind": f"{RodPlant.__module__}.{RodPlant.__name__}", "refine": 1, "tendon_damping": 20.0}
    env = DynamicArm(ARM, 0.02, False, torch.empty(0, dtype=D), plant={**kind, "substeps": 2, **ALL})
    rows = row_parameters(2, payload=numbers(0.1, 0.2), lengths=torch.ones(2, 2, dtype=D))
    state = first = env.initial(rows)
    y = 0.02 * torch.cos(torch.arange(12, dtype=D)).view(2, 6)
    for _ in range(2):
        state = env.step(state, torch.zeros_like(y), y, y, rows)
    events, places = ({**ALL}[name] for name in ("events", "places"))
    alone = plant(numbers(0.1, 0.2), RodPlant, backlash=ALL["backlash"], events=events, places=places)
    own = first
    for _ in range(2):
        own = run(alone, y, 2, 0.01, own)
    torch.testing.assert_close(state.arm, own.arm, rtol=0, atol=1e-12)
    tips = env.points(state, rows).backbone[:, -1]
    torch.testing.assert_close(tips, tip(alone, own), rtol=0, atol=1e-12)
