"""One emulated bus for all these tests, with new motors for each."""

from __future__ import annotations

from collections.abc import Iterator

import pytest

from apcc_torch.hardware.dynamixel.actuator import DynamixelActuator
from hardware.dynamixel.rig import POSITIONS, settings
from hardware.emulators.servo.emulator import ServoEmulator


@pytest.fixture(scope="session")
def bus(tmp_path_factory: pytest.TempPathFactory) -> Iterator[ServoEmulator]:
    emulator = ServoEmulator(tmp_path_factory.mktemp("bus") / "servos", POSITIONS)
    yield emulator
    emulator.close()


@pytest.fixture
def emulator(bus: ServoEmulator) -> ServoEmulator:
    """The bus, plugged in, with motors as from the factory."""
    bus.do("unplug")
    bus.do("plug")
    bus.do("fresh")
    return bus


@pytest.fixture
def actuator(emulator: ServoEmulator) -> Iterator[DynamixelActuator]:
    """Connected and calibrated, without torque."""
    device = DynamixelActuator(settings(emulator.link))
    device.connect()
    device.calibrate()
    yield device
    device.disconnect()
