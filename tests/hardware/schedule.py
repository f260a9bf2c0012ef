"""Whatever goes wrong, and in whatever order: what a program does, what is done to it, and what has to hold."""

from __future__ import annotations

import contextlib
from collections.abc import Mapping, Sequence
from math import pi
from typing import Any

import numpy as np
from hypothesis import strategies as st

from apcc_torch.errors import ApccError
from apcc_torch.hardware.servos.actuator import ServoActuator
from hardware.emulators.servo.emulator import ServoEmulator

LENGTHS = st.one_of(st.floats(-0.1, 0.05), st.sampled_from([1e300, -1e300, 0.0, -0.035, -0.075]))
COMMANDS = st.lists(LENGTHS, min_size=9, max_size=9)


def schedules(motors: Sequence[int], *more: Any, troubles: Sequence[str] = ("overload", "restart")) -> Any:
    """Steps with a command each. After every step the program reads and sends, whatever the reading said."""
    motor, count = st.sampled_from(list(motors)), st.integers(1, 4)
    steps = st.one_of(
        st.tuples(st.just("send"), st.tuples(*[st.sampled_from([0.0, np.nan, np.inf, -np.inf])] * 9)),
        st.tuples(st.sampled_from(["hold", "arm", "calibrate", "torque_off", "reconnect", "recover", "recover"])),
        st.tuples(st.sampled_from(["mute", "corrupt", "cut", "short"]), motor, count),
        st.tuples(st.sampled_from(list(troubles)), motor),
        st.tuples(st.just("turn"), motor, st.integers(-9000, 9000)),
        st.tuples(st.just("error"), motor, st.integers(0, 7)),
        st.tuples(st.just("replug")),
        *more,
    )
    return st.lists(st.tuples(steps, COMMANDS), min_size=4, max_size=15)


class Schedule:
    """Runs steps, and watches the goals that the motors are given.

    Args:
        emulator: The bus, which is made new.
        device: The driver, not yet connected.
        rig: TENDONS, POSITIONS, SIGNS, RADII and LOWER of the tendons.
        fault: Address of the register in which a motor reports its faults.
        gripper: Least and greatest goal of motors that are no tendon's, by id.
    """

    def __init__(
        self,
        emulator: ServoEmulator,
        device: ServoActuator,
        rig: Any,
        fault: int,
        gripper: Mapping[int, tuple[int, int]] | None = None,
    ) -> None:
        emulator.do("unplug")
        emulator.do("plug")
        emulator.do("fresh")
        self.emulator = emulator
        self.device = device
        self.rig = rig
        self.fault = fault
        self.others = gripper or {}
        self.motors = (*rig.TENDONS, *self.others)
        self.seen = dict.fromkeys(self.motors, 0)
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
        for motor in self.motors:
            self.emulator.do("restart", motor)
            self.emulator.do("turn", motor, position=self.rig.POSITIONS[motor])
        self.reconnect()
        self.calibrate()
        self.device.arm()

    def take(self, name: str, *details: Any) -> None:
        if name in ("hold", "arm", "torque_off"):
            getattr(self.device, name)()
        elif name in ("send", "calibrate", "reconnect", "recover", "turn", "replug"):
            getattr(self, name)(*details)
        elif name == "gripper":
            self.device.gripper.goal(*details)  # type: ignore[attr-defined]
        elif name == "error":
            self.emulator.do("poke", details[0], address=self.fault, length=1, value=1 << details[1])
        elif len(details) == 2:
            self.emulator.do(name, details[0], count=details[1], amount=2)
        else:
            self.emulator.do(name, details[0])

    def send(self, y: Sequence[float]) -> None:
        sent = self.device.send(np.array(y))
        assert (sent >= np.array(self.rig.LOWER) - 1e-9).all() and (sent <= 1e-9).all()

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
                if motor in self.others:
                    least, most = self.others[motor]
                    assert least <= goal <= most
                    continue
                k = self.rig.TENDONS.index(motor)
                assert self.zero is not None
                y = self.rig.SIGNS[k] * self.rig.RADII[k] * 2 * pi * (goal - self.zero[k]) / 4096
                assert self.rig.LOWER[k] - 1e-9 <= y <= 1e-9

    def run(self, steps: Sequence[tuple[Any, Any]]) -> None:
        """All of them; at the end the line is made whole, and letting go has to reach every motor."""
        try:
            for step, y in steps:
                self.step(*step, y=y)
            self.emulator.do("heal")
            if self.device.bus.is_open:
                self.let_go()
                assert not any(found["torque"] for found in self.emulator.report().values())
        finally:
            self.device.disconnect()
            self.check_goals()
