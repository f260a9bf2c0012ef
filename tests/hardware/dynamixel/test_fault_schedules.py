"""Whatever goes wrong, and in whatever order: no goal outside the limits reaches the bus, and no error is unnamed."""

from __future__ import annotations

from math import pi
from typing import Any

import numpy as np
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from apcc_torch.hardware.dynamixel.actuator import DynamixelActuator
from hardware.dynamixel import rig
from hardware.emulators.servo.emulator import ServoEmulator
from hardware.schedule import Schedule, schedules

GRIPPER = st.tuples(st.just("gripper"), st.one_of(st.floats(-3, 3), st.just(np.nan)))
STEPS = schedules((*rig.TENDONS, rig.GRIPPER), GRIPPER, troubles=("trip", "overload", "restart"))
ENDS = (round(4096 / (2 * pi)), round(2 * 4096 / (2 * pi)))


@settings(max_examples=40, suppress_health_check=[HealthCheck.too_slow])
@given(steps=STEPS)
def test_no_schedule_of_faults_sends_a_goal_outside_the_limits(bus: ServoEmulator, steps: list[Any]) -> None:
    quick = rig.settings(bus.link, reply_timeout=0.03, release_torqued=True, bus_watchdog=0.5)
    Schedule(bus, DynamixelActuator(quick), rig, fault=70, gripper={rig.GRIPPER: ENDS}).run(steps)
