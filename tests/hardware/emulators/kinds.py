"""What may stand at the tendons of the emulated platform: makes, models and modes, with the settings that fit."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

from hardware.emulators.servo.models import XL330_M288, XL430_W250, XM430_W210, XM430_W350

MOTORS = tuple(range(11, 20))
RADII = (0.01, 0.01, 0.01, 0.012, 0.012, 0.012, 0.02, 0.02, 0.02)
SIGNS = (1, -1, 1, -1, 1, -1, 1, -1, 1)
LOWER, UPPER = -0.12, 0.12  # m; the emulated tendons push as well
# The fourth, which the table of faults has, is the paper's.
MIXED = (XM430_W210,) * 4 + (XL430_W250,) * 2 + (XL330_M288,) * 2 + (XM430_W350,)
MODE = {"address": 11, "length": 1, "value": 1}


@dataclass(frozen=True, eq=False)
class Kind:
    """One kind of motors.

    program: Of the emulator. preset: Of conf/hardware. turn: Ticks between the zeros of two motors. settings: Of the
    actuator, where they are not those of all. prompt: Those that a machine with free cores can keep. models: By id.
    before: What the motors are told when they are new. watchdog: Whether they stop by themselves.
    """

    name: str
    program: str = "hardware.emulators.servo"
    preset: str = "dynamixel_optitrack"
    turn: int = 9000
    settings: Mapping[str, Any] = field(default_factory=dict)
    prompt: Mapping[str, Any] = field(default_factory=dict)
    models: Mapping[int, int] = field(default_factory=dict)
    before: Mapping[str, float] | None = None
    watchdog: bool = True

    @property
    def zeros(self) -> tuple[int, ...]:
        """Ticks at which the arm hangs straight: turns away from the encoders' own."""
        return tuple(self.turn * (motor - 15) + 17 for motor in MOTORS)

    @property
    def actuator(self) -> dict[str, Any]:
        """Settings that fit, with times that a busy machine keeps."""
        common = {
            "ids": list(MOTORS), "spool_radii": list(RADII), "signs": list(SIGNS), "lower": LOWER, "upper": UPPER,
            "reply_timeout": 1.0, "profile_velocity": 20.0,
        }  # fmt: skip
        dynamixel = {"bus_watchdog": 2.54, "profile_acceleration": 400.0} if self.watchdog else {}
        return common | dynamixel | dict(self.settings)


DYNAMIXEL = Kind("dynamixel")
VELOCITY = Kind(
    "velocity",
    settings={"mode": "velocity", "velocity_gain": 0.39},
    prompt={"bus_watchdog": 0.1, "velocity_gain": 8.0},
    before=MODE,
)
MIXED_MODELS = Kind("mixed", settings={"model_number": list(MIXED)}, models=dict(zip(MOTORS, MIXED, strict=True)))
FEETECH = Kind(
    "feetech",
    program="hardware.emulators.feetech",
    preset="feetech_optitrack",
    turn=5000,
    settings={"profile_acceleration": 35.0},
    watchdog=False,
)
KINDS = {kind.name: kind for kind in (DYNAMIXEL, VELOCITY, MIXED_MODELS, FEETECH)}
