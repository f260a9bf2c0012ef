"""One emulated bus for all these tests, with new servos for each."""

from __future__ import annotations

from collections.abc import Iterator

import pytest

from apcc_torch.hardware.feetech.actuator import FeetechActuator
from hardware.emulators.servo.emulator import ServoEmulator
from hardware.feetech.rig import POSITIONS, PROGRAM, nothing_forbidden, settings


@pytest.fixture(scope="session")
def sts_bus(tmp_path_factory: pytest.TempPathFactory) -> Iterator[ServoEmulator]:
    emulator = ServoEmulator(tmp_path_factory.mktemp("bus") / "servos", POSITIONS, program=PROGRAM)
    yield emulator
    emulator.close()


@pytest.fixture
def emulator(sts_bus: ServoEmulator) -> ServoEmulator:
    """The bus, plugged in, with servos that were used in this mode before."""
    sts_bus.do("unplug")
    sts_bus.do("plug")
    sts_bus.do("fresh")
    return sts_bus


@pytest.fixture
def actuator(emulator: ServoEmulator) -> Iterator[FeetechActuator]:
    """Connected and calibrated, without torque."""
    device = FeetechActuator(settings(emulator.link))
    device.connect()
    device.calibrate()
    yield device
    device.disconnect()
    nothing_forbidden(emulator)


@pytest.fixture
def armed(actuator: FeetechActuator) -> FeetechActuator:
    """With torque."""
    actuator.arm()
    return actuator
