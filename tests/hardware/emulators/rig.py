"""The paper's whole platform, emulated: motors on a pseudo terminal, cameras on loopback, and the arm in between.

Each emulator is a process of its own; the real drivers talk to them. `overrides` are the settings of
apcc_torch.robot that fit.
"""

from __future__ import annotations

from contextlib import ExitStack
from pathlib import Path
from typing import Self

import numpy as np

from hardware.emulators.arm import EmulatedArm
from hardware.emulators.kinds import DYNAMIXEL, LOWER, MOTORS, RADII, SIGNS, UPPER, Kind
from hardware.emulators.line import positions_file
from hardware.emulators.mocap_server import MocapServer
from hardware.emulators.natnet_server import NatNetServer
from hardware.emulators.qtm_server import QtmServer
from hardware.emulators.servo.emulator import ServoEmulator

STEP = 0.01  # m between two commands
MAKES: dict[str, tuple[type[MocapServer], str]] = {
    "optitrack": (NatNetServer, "command_port"),
    "qualisys": (QtmServer, "port"),
}
"""Emulator of each make of cameras, and the setting that has its port."""
NAMES = {1: "base", 2: "disk_1", 3: "disk_3", 4: "disk_5"}


class EmulatedPlatform:
    """Runs the emulators; a context manager.

    Args:
        folder: For the terminal's name.
        frame_rate: Of the cameras, Hz.
        kind: The motors.
        make: Of the cameras, one of `MAKES`.
    """

    def __init__(self, folder: Path, frame_rate: float = 50.0, kind: Kind = DYNAMIXEL, make: str = "optitrack") -> None:
        self.kind = kind
        self.link = folder / "servos"
        self.frame_rate = frame_rate
        self.make = make

    def __enter__(self) -> Self:
        self.stack = ExitStack()
        start = dict(zip(MOTORS, self.kind.zeros, strict=True))
        self.servos = ServoEmulator(self.link, start, self.kind.models, self.kind.program)
        self.stack.callback(self.servos.close)
        self._used()
        per_tick = [sign * radius * 2 * np.pi / 4096 for sign, radius in zip(SIGNS, RADII, strict=True)]
        self.arm = EmulatedArm(positions_file(self.link), self.kind.zeros, per_tick)
        self.cameras = self.stack.enter_context(MAKES[self.make][0](NAMES, self.arm, rate=self.frame_rate))
        return self

    def __exit__(self, *unused: object) -> None:
        self.stack.close()

    def renew(self) -> None:
        """Everything plugged in, new motors at zero, no faults."""
        self.servos.do("unplug")
        self.servos.do("plug")
        self.servos.do("fresh")
        self._used()
        self.cameras.fault()
        self.cameras.restart(version=type(self.cameras).version)

    def _used(self) -> None:
        if self.kind.before is not None:
            for motor in MOTORS:
                self.servos.do("poke", motor, **self.kind.before)

    @property
    def overrides(self) -> list[str]:
        """Settings that fit, with times that a busy machine keeps."""
        motors = {"port": self.link} | self.kind.actuator
        cameras = {
            "server": "127.0.0.1", "interface": "127.0.0.1", MAKES[self.make][1]: self.cameras.command_port,
            "base_frames": 5, "max_age": 0.6, "timeout": 0.9, "connect_timeout": 20.0, "max_speed": 5.0,
            "max_angular_rate": 40.0,
        }  # fmt: skip
        return [
            f"hardware={self.kind.preset.replace('optitrack', self.make)}",
            "guards=simulated",
            f"guards.limits.lower={LOWER}",
            f"guards.limits.upper={UPPER}",
            f"guards.limits.step={STEP}",
            *(f"hardware.actuator.{key}={_text(value)}" for key, value in motors.items()),
            *(f"hardware.sensor.{key}={value}" for key, value in cameras.items()),
        ]

    def goals_in_limits(self) -> bool:
        """Whether no motor was ever told to go outside the limits, or was there: whole ticks of arc length.

        The last goal may be that of a hold, which is where the motor was, however far it lagged behind.
        """
        report = self.servos.report()
        for k, motor in enumerate(MOTORS):
            zero = self.kind.zeros[k]
            reach = self.arm.metres_per_tick[k] * (np.array(report[motor]["reach"]) - zero)
            # Torque that somebody else left on is not the driver's doing.
            if report[motor]["told"] and (reach.min() < LOWER - 1e-4 or reach.max() > UPPER + 1e-4):
                return False
            y = self.arm.metres_per_tick[k] * (np.array(report[motor]["goals"]) - zero)
            if len(y) and (y.min() < LOWER - 1e-9 or y.max() > UPPER + 1e-9):
                return False
            if len(y) > 2 and np.abs(np.diff(y[:-1])).max() > STEP + 1e-9:
                return False
        return True


def _text(value: object) -> str:
    return str(value).replace(" ", "")
