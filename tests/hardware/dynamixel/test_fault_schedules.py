"""Whatever goes wrong, and in whatever order: no goal outside the limits reaches the bus, and no error is unnamed."""

from __future__ import annotations

import contextlib
from collections.abc import Sequence
from math import pi
from typing import Any

import numpy as np
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from apcc_torch.errors import ApccError
from apcc_torch.hardware.dynamixel.actuator import DynamixelActuator
from hardware.dynamixel import rig
from hardware.emulators.servo.emulator import ServoEmulator

MOTORS = (*rig.TENDONS, rig.GRIPPER)
LENGTHS = st.one_of(st.floats(-0.1, 0.05), st.sampled_from([1e300, -1e300, 0.0, -0.035, -0.075]))
COMMANDS = st.lists(LENGTHS, min_size=9, max_size=9)
MOTOR = st.sampled_from(MOTORS)
COUNT = st.integers(1, 4)

# What the program does, and what is done to it. After each the program reads and
# sends, whatever the reading said.
STEPS = st.one_of(
    st.tuples(st.just("send"), st.tuples(*[st.sampled_from([0.0, np.nan, np.inf, -np.inf])] * 9)),
    st.tuples(st.just("gripper"), st.one_of(st.floats(-3, 3), st.just(np.nan))),
    st.tuples(st.sampled_from(["hold", "arm", "calibrate", "torque_off", "reconnect", "recover", "recover"])),
    st.tuples(st.sampled_from(["mute", "corrupt", "cut", "short"]), MOTOR, COUNT),
    st.tuples(st.sampled_from(["trip", "overload", "restart"]), MOTOR),
    st.tuples(st.just("turn"), MOTOR, st.integers(-9000, 9000)),
    st.tuples(st.just("error"), MOTOR, st.integers(0, 7)),
    st.tuples(st.just("replug")),
)


class Schedule:
    """Runs steps, and watches the goals that the motors are given."""

    def __init__(self, emulator: ServoEmulator) -> None:
        emulator.do("unplug")
        emulator.do("plug")
        emulator.do("fresh")
        self.emulator = emulator
        self.device = DynamixelActuator(
            rig.settings(emulator.link, reply_timeout=0.03, release_torqued=True, bus_watchdog=0.5)
        )
        self.seen = dict.fromkeys(MOTORS, 0)
        self.zero: list[int] | None = None
        with contextlib.suppress(ApccError):
            self.device.connect()
            self.calibrate()
            self.device.arm()

    def calibrate(self) -> None:
        found = self.device.calibrate()["zero_ticks"]
        assert isinstance(found, list)
        self.zero = found

    def reconnect(self) -> None:
        self.device.disconnect()
        self.device.connect()

    def step(self, name: str, *details: Any, y: list[float]) -> None:
        """One step and a command; the errors of the toolkit are their right, any other exception fails the test."""
        with contextlib.suppress(ApccError):
            self.take(name, *details)
        self.check_goals()
        for then in (self.device.read, lambda: self.send(y)):
            with contextlib.suppress(ApccError):
                then()
        self.check_goals()

    def recover(self) -> None:
        """What a person does: everything whole, and begun again."""
        self.emulator.do("heal")
        for motor in MOTORS:
            self.emulator.do("restart", motor)
            self.emulator.do("turn", motor, position=rig.POSITIONS[motor])
        self.reconnect()
        self.calibrate()
        self.device.arm()

    def take(self, name: str, *details: Any) -> None:
        if name in ("hold", "arm", "torque_off"):
            getattr(self.device, name)()
        elif name in ("send", "calibrate", "reconnect", "recover", "turn", "replug"):
            getattr(self, name)(*details)
        elif name == "gripper":
            self.device.gripper.goal(*details)
        elif name == "error":
            self.emulator.do("poke", details[0], address=70, length=1, value=1 << details[1])
        elif len(details) == 2:
            self.emulator.do(name, details[0], count=details[1], amount=2)
        else:
            self.emulator.do(name, details[0])

    def send(self, y: Sequence[float]) -> None:
        sent = self.device.send(np.array(y))
        assert (sent >= np.array(rig.LOWER) - 1e-9).all() and (sent <= 1e-9).all()

    def replug(self) -> None:
        self.emulator.do("unplug")
        self.emulator.do("plug")
        with contextlib.suppress(ApccError):
            self.device.read()
        self.recover()

    def let_go(self) -> None:
        """Torque off, tried again while it fails: the replies' time is short, and the machine may be busy."""
        for _ in range(20):
            with contextlib.suppress(ApccError):
                self.device.torque_off()
                return

    def turn(self, motor: int, ticks: int) -> None:
        self.emulator.do("turn", motor, position=self.emulator.report()[motor]["position"] + ticks)

    def check_goals(self) -> None:
        for motor, found in self.emulator.report().items():
            fresh = found["goals"][self.seen[motor] :]
            self.seen[motor] = len(found["goals"])
            for goal in fresh:
                if motor == rig.GRIPPER:
                    assert round(4096 / (2 * pi)) <= goal <= round(2 * 4096 / (2 * pi))
                    continue
                k = rig.TENDONS.index(motor)
                assert self.zero is not None
                y = rig.SIGNS[k] * rig.RADII[k] * 2 * pi * (goal - self.zero[k]) / 4096
                assert rig.LOWER[k] - 1e-9 <= y <= 1e-9


@settings(max_examples=40, suppress_health_check=[HealthCheck.too_slow])
@given(steps=st.lists(st.tuples(STEPS, COMMANDS), min_size=4, max_size=15))
def test_no_schedule_of_faults_sends_a_goal_outside_the_limits(bus: ServoEmulator, steps: list[tuple]) -> None:
    schedule = Schedule(bus)
    try:
        for step, y in steps:
            schedule.step(*step, y=y)
        bus.do("heal")
        if schedule.device.bus.is_open:  # with the line whole again, letting go reaches every motor
            schedule.let_go()
            assert not any(found["torque"] for found in bus.report().values())
    finally:
        schedule.device.disconnect()
        schedule.check_goals()
