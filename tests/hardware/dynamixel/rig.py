"""The rig of these tests: nine tendons and a gripper on the emulated bus, and the settings that fit it."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from apcc_torch.hardware.dynamixel.settings import DynamixelSettings, GripperSettings
from hardware.emulators.servo.emulator import ServoEmulator

TENDONS = tuple(range(11, 20))
GRIPPER = 30
# Ids are not the tendons' numbers, radii and signs differ, and some zeros are many turns away.
POSITIONS = {motor: 9000 * (motor - 15) + 17 for motor in TENDONS} | {GRIPPER: 1000}
RADII = (0.01, 0.01, 0.01, 0.012, 0.012, 0.012, 0.02, 0.02, 0.02)
SIGNS = (1, -1, 1, -1, 1, -1, 1, -1, 1)
LOWER = (-0.035,) * 3 + (-0.075,) * 6


def settings(port: Path, **changes: Any) -> DynamixelSettings:
    """Settings of the rig. Replies may take long: the machine that runs the tests may be busy."""
    base: dict[str, Any] = {
        "port": str(port),
        "ids": TENDONS,
        "spool_radii": RADII,
        "signs": SIGNS,
        "lower": LOWER,
        "upper": (0.0,) * 9,
        "bus_watchdog": 2.0,
        "reply_timeout": 0.8,
        "gripper": GripperSettings(id=GRIPPER, open_angle=1.0, closed_angle=2.0),
    }
    return DynamixelSettings(**(base | changes))


def goals_in_limits(emulator: ServoEmulator) -> None:
    """Asserts that the bus has seen no goal outside the limits, by a rule of its own: whole ticks of arc length."""
    report = emulator.report()
    for k, motor in enumerate(TENDONS):
        for goal in report[motor]["goals"]:
            y = SIGNS[k] * RADII[k] * 2 * 3.141592653589793 * (goal - POSITIONS[motor]) / 4096
            assert LOWER[k] - 1e-9 <= y <= 1e-9, f"motor {motor} was told to go to {y} m"
