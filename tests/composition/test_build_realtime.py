"""Settings of a run in real time to its parts, and what they refuse."""

from __future__ import annotations

from math import pi

import numpy as np
import pytest

from apcc_torch.composition.build_realtime import RealtimeBuilder
from apcc_torch.control.trajectory import SetPoint, SineTrajectory
from apcc_torch.errors import ApccError
from apcc_torch.hardware.clock import MonotonicClock, VirtualClock
from apcc_torch.hardware.dry_run import DryRunActuator
from apcc_torch.hardware.stops import Ending, StopReason
from apcc_torch.native import NativeFunction, TorchStep
from composed import composed, composed_realtime


def builder(*overrides: str) -> RealtimeBuilder:
    return RealtimeBuilder(composed_realtime(*overrides))


def test_the_set_point_is_the_papers_for_the_arm_and_for_the_simulation() -> None:
    build = builder("experiment=setpoint")
    trajectory = build.trajectory()
    assert isinstance(trajectory, SetPoint) and trajectory.x_d.tolist() == [0.0, 0.15, -0.5]
    assert build.guards().arrival_error == 1e-3 and build.settings.experiment.duration == 30.0
    simulated = composed("experiment=setpoint")
    assert simulated.experiment.setpoints == ([0.0, 0.15, -0.5],)
    assert simulated.controller.K == build.settings.controller.K == 1.5


def test_a_sine_cannot_be_arrived_at() -> None:
    build = builder("experiment=tracking", "experiment.payloads=[0.0]")
    assert isinstance(build.trajectory(), SineTrajectory)
    assert build.guards().arrival_error is None


def test_limits_are_a_number_or_one_a_tendon() -> None:
    limits = builder("experiment=setpoint", "guards=platform").limits()
    assert limits.lower.tolist() == [-0.035] * 3 + [-0.075] * 6
    assert limits.upper.tolist() == [0.0] * 9 and np.ptp(limits.rate) == 0.0
    assert builder("experiment=setpoint", "guards.limits.lower=-0.1").limits().lower.tolist() == [-0.1] * 9


def test_devices_are_those_asked_for() -> None:
    assert isinstance(builder("experiment=setpoint").devices().world.clock, MonotonicClock)
    lockstep = builder("experiment=setpoint", "hardware=lockstep", "dry_run=true").devices()
    assert isinstance(lockstep.world.clock, VirtualClock) and isinstance(lockstep.actuator, DryRunActuator)


def test_the_gate_judges_in_the_base() -> None:
    build = builder("experiment=setpoint")
    sensing = build.sensing()
    assert np.allclose(sensing.to_base[:3, :3], np.diag([1.0, -1.0, -1.0]))
    assert sensing.gate.max_reach.tolist() == pytest.approx([1.5 * x for x in (0.105, 0.36, 0.60)])
    assert bool((sensing.gate.max_bend <= pi).all())


def test_frames_are_judged_as_the_step_is_run() -> None:
    for mode, kind in (("off", TorchStep), ("aot", NativeFunction)):
        build = builder("experiment=setpoint", f"compile={mode}")
        assert isinstance(build.sensing()._judge._step, kind) and isinstance(build.control().step, kind)


def test_endings_can_be_changed() -> None:
    guards = builder("experiment=setpoint", "guards.endings.over_effort=torque_off").guards()
    assert guards.ending(StopReason.OVER_EFFORT) is Ending.TORQUE_OFF


@pytest.mark.parametrize(
    ("override", "sentence"),
    [
        ("experiment=dynamic_run_2", "experiment.setpoints must hold one point"),
        ("experiment.payloads=[0.0,0.5]", "experiment.payloads must hold one payload"),
        ("hardware.actuator=dynamixel", "hardware.actuator.kind must name a class"),
        ("loop.rate=501", r"loop\.rate must be in \[20, 500\], got 501"),
        ("guards.limits.upper=[0,0]", "guards.limits.upper must have 9 entries"),
        ("guards.limits.lower=5", "guards.limits.lower must be below upper"),
        ("guards.limits.rate=0", r"guards\.limits\.rate must be positive"),
        ("guards.endings.late=hold", r"guards\.endings must be one of arrived, .*, got 'late'"),
        ("arm.sensed=[pose,pose,tilt]", "the loop on an arm reads poses alone"),
        ("arm.curvature_sensors=[0.1]", "the loop on an arm reads poses alone"),
        ("guards.sensing.stale=0", r"guards\.sensing\.stale must be positive"),
        ("guards.sensing.gate.max_bend=[1,2]", r"guards\.sensing\.gate\.max_bend must have 3 entries, got 2"),
        ("guards.sensing.gate.max_ben=1", r"guards\.sensing\.gate\.max_ben is no setting; did you mean max_bend"),
    ],
)
def test_a_setting_without_meaning_is_refused(override: str, sentence: str) -> None:
    def build_all() -> None:
        build = builder("experiment=setpoint", override)
        build.trajectory(), build.payload(), build.devices()
        build.limits(), build.guards(), build.sensing()

    with pytest.raises(ApccError, match=sentence):
        build_all()
