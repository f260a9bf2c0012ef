"""The rig of these tests: nine tendons on the emulated bus, and the settings that fit it."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from apcc_torch.hardware.feetech.settings import FeetechSettings
from hardware.emulators.servo.emulator import ServoEmulator

TENDONS = tuple(range(11, 20))
# Some zeros are turns away, on either side of the encoders' own.
POSITIONS = {motor: 5000 * (motor - 15) + 17 for motor in TENDONS}
RADII = (0.01, 0.01, 0.01, 0.012, 0.012, 0.012, 0.02, 0.02, 0.02)
SIGNS = (1, -1, 1, -1, 1, -1, 1, -1, 1)
LOWER = (-0.035,) * 3 + (-0.075,) * 6
PROGRAM = "hardware.emulators.feetech"


def settings(port: Path, **changes: Any) -> FeetechSettings:
    """Settings of the rig. Replies may take long: the machine that runs the tests may be busy."""
    base: dict[str, Any] = {
        "port": str(port),
        "ids": TENDONS,
        "spool_radii": RADII,
        "signs": SIGNS,
        "lower": LOWER,
        "upper": (0.0,) * 9,
        "reply_timeout": 0.9,
    }
    return FeetechSettings(**(base | changes))


def nothing_forbidden(emulator: ServoEmulator) -> None:
    """Asserts that the bus has seen no goal outside the limits, and no servo was told to move its middle."""
    for k, (motor, found) in enumerate(emulator.report().items()):
        assert found["calibrated"] == 0
        for goal in found["goals"]:
            y = SIGNS[k] * RADII[k] * 2 * 3.141592653589793 * (goal - POSITIONS[motor]) / 4096
            assert LOWER[k] - 1e-9 <= y <= 1e-9, f"servo {motor} was told to go to {y} m"
