"""Whatever goes wrong, and in whatever order: no goal outside the limits, no unnamed error, no middle that is moved."""

from __future__ import annotations

from typing import Any

from hypothesis import HealthCheck, given, settings

from apcc_torch.hardware.feetech.actuator import FeetechActuator
from hardware.emulators.servo.emulator import ServoEmulator
from hardware.feetech import rig
from hardware.schedule import Schedule, schedules


@settings(max_examples=15, suppress_health_check=[HealthCheck.too_slow])
@given(steps=schedules(rig.TENDONS))
def test_no_schedule_of_faults_sends_a_goal_outside_the_limits(sts_bus: ServoEmulator, steps: list[Any]) -> None:
    quick = rig.settings(sts_bus.link, reply_timeout=0.03, release_torqued=True)
    Schedule(sts_bus, FeetechActuator(quick), rig, fault=65).run(steps)
    assert not any(found["calibrated"] for found in sts_bus.report().values())
