"""What connecting refuses."""

from __future__ import annotations

import pytest

from apcc_torch.errors import CommunicationError, DeviceFaultError, HardwareError
from apcc_torch.hardware.dynamixel.actuator import DynamixelActuator
from hardware.dynamixel.rig import GRIPPER, POSITIONS, TENDONS, settings
from hardware.emulators.servo.emulator import ServoEmulator

MOTOR = TENDONS[5]


def refused(emulator: ServoEmulator, error: type[HardwareError], said: str) -> None:
    actuator = DynamixelActuator(settings(emulator.link))
    with pytest.raises(error, match=said) as caught:
        actuator.connect()
    assert type(caught.value) is error
    assert not actuator.bus.is_open
    assert all(not found["goals"] for found in emulator.report().values())


@pytest.mark.parametrize(("motor", "name"), [(MOTOR, r"motor 6 \(id 16\)"), (GRIPPER, r"gripper \(id 30\)")])
def test_a_missing_motor(emulator: ServoEmulator, motor: int, name: str) -> None:
    emulator.do("mute", motor)
    refused(emulator, CommunicationError, f"{name}: no reply")


def test_another_model(emulator: ServoEmulator) -> None:
    emulator.do("poke", MOTOR, address=0, length=2, value=1020)
    refused(emulator, HardwareError, r"motor 6 \(id 16\) is model 1020, not 1030")


def test_old_firmware(emulator: ServoEmulator) -> None:
    emulator.do("poke", MOTOR, address=6, length=1, value=37)
    refused(emulator, HardwareError, r"motor 6 \(id 16\) has firmware 37, older than 38")


def test_a_latched_hardware_error(emulator: ServoEmulator) -> None:
    emulator.do("overload", MOTOR)
    refused(emulator, DeviceFaultError, r"motor 6 \(id 16\) reports overload: turn its power off and on")


def test_motors_that_hold_torque(emulator: ServoEmulator) -> None:
    for motor in (MOTOR, GRIPPER):
        emulator.do("poke", motor, address=64, length=1, value=1)
    refused(emulator, HardwareError, r"motor 6 \(id 16\), gripper \(id 30\) holds torque already")
    assert emulator.report()[MOTOR]["torque"] == 1  # it may carry the arm for somebody
    with DynamixelActuator(settings(emulator.link, release_torqued=True)):
        assert emulator.report()[MOTOR]["torque"] == 0


def test_a_port_in_use(emulator: ServoEmulator) -> None:
    with DynamixelActuator(settings(emulator.link)):
        refused(emulator, CommunicationError, "cannot open the port .*lock")


def test_a_baud_rate_that_is_none(emulator: ServoEmulator) -> None:
    with pytest.raises(CommunicationError, match="no baud rate 123456"):
        DynamixelActuator(settings(emulator.link, baud=123_456)).connect()


def test_a_watchdog_that_tripped_in_an_earlier_program_is_cleared(emulator: ServoEmulator) -> None:
    emulator.do("poke", MOTOR, address=98, length=1, value=255)
    with DynamixelActuator(settings(emulator.link)) as actuator:
        actuator.calibrate()
        actuator.arm()
        actuator.read()
    assert emulator.report()[MOTOR]["refused"] == 0
    assert emulator.report()[MOTOR]["goal"] == POSITIONS[MOTOR]
