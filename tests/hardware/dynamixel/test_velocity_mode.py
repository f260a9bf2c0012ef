"""The driver in mode velocity on the emulated bus: there and back, what stops it, and what a hold means."""

from __future__ import annotations

import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from apcc_torch.errors import CommunicationError, DeviceFaultError
from apcc_torch.hardware.dynamixel.actuator import DynamixelActuator
from hardware.dynamixel.rig import GRIPPER, LOWER, POSITIONS, RADII, SIGNS, TENDONS, settings
from hardware.emulators.servo.emulator import ServoEmulator


@pytest.fixture
def used(emulator: ServoEmulator) -> ServoEmulator:
    """Motors that were in this mode before: with another they forget their turns."""
    for motor in TENDONS:
        emulator.do("poke", motor, address=11, length=1, value=1)
    return emulator


def velocity(port: Path, **changes: Any) -> Any:
    # A watchdog that a busy machine keeps, and the gain that goes with it.
    return settings(port, mode="velocity", **({"bus_watchdog": 2.0, "velocity_gain": 0.5} | changes))


@pytest.fixture
def armed(used: ServoEmulator) -> Iterator[DynamixelActuator]:
    """Calibrated, with torque."""
    with DynamixelActuator(velocity(used.link)) as device:
        device.calibrate()
        device.arm()
        yield device


def peek(emulator: ServoEmulator, motor: int, address: int, length: int) -> int:
    return int(emulator.do("peek", motor, address=address, length=length, signed=True)["value"])


def speeds(emulator: ServoEmulator) -> list[int]:
    return [peek(emulator, motor, 104, 4) for motor in TENDONS]


def go(actuator: DynamixelActuator, y: np.ndarray, seconds: float) -> None:
    end = time.monotonic() + seconds
    while time.monotonic() < end:
        actuator.read()
        actuator.send(y)
        time.sleep(0.005)


def within_limits(emulator: ServoEmulator) -> None:
    """Asserts where the motors have been, by a rule of its own."""
    for k, (motor, found) in enumerate(list(emulator.report().items())[:9]):
        for position in found["reach"]:
            y = SIGNS[k] * RADII[k] * 2 * np.pi * (position - POSITIONS[motor]) / 4096
            assert LOWER[k] - 1e-5 <= y <= 1e-5, f"motor {motor} was at {y} m"


def test_arming_moves_nothing_and_limits_the_voltage(armed: DynamixelActuator, emulator: ServoEmulator) -> None:
    # 1 A of the 2.3 A that the motor draws of 12 V at a stall.
    assert peek(emulator, TENDONS[0], 100, 2) == int(885 * 1.0 / 2.3)
    assert peek(emulator, TENDONS[0], 11, 1) == 1 and peek(emulator, GRIPPER, 11, 1) == 5
    assert peek(emulator, GRIPPER, 100, 2) == 885
    assert speeds(emulator) == [0] * 9
    assert all(found["position"] == POSITIONS[motor] for motor, found in emulator.report().items())
    assert all(found["torque"] for found in emulator.report().values())


def test_tendons_go_where_they_are_sent_and_stay(armed: DynamixelActuator, emulator: ServoEmulator) -> None:
    y = np.linspace(-0.001, -0.005, 9)
    armed.read()
    sent = armed.send(y)
    assert np.abs(sent - y).max() <= 0.5 * 0.02 * 2 * np.pi / 4096
    assert any(speed != 0 for speed in speeds(emulator))
    go(armed, y, 12.0)
    # The last ticks ask for less than one unit of velocity: with a gain of 0.5/s, 32 of them.
    assert (np.abs(armed.read().y - sent) <= 32 * np.array(RADII) * 2 * np.pi / 4096).all()
    assert speeds(emulator) == [0] * 9
    within_limits(emulator)


def test_a_lost_reply_stops_every_motor_and_the_next_reading_sets_them_going(
    armed: DynamixelActuator, emulator: ServoEmulator
) -> None:
    far = np.full(9, -0.03)
    go(armed, far, 0.1)
    assert all(speeds(emulator))
    emulator.do("corrupt", TENDONS[3], count=1)
    with pytest.raises(CommunicationError, match=r"motor 4 \(id 14\)"):
        armed.read()
    assert speeds(emulator) == [0] * 9
    armed.send(far)
    assert speeds(emulator) == [0] * 9, "there was no reading since"
    armed.read()
    armed.send(far)
    assert all(speeds(emulator))


def test_hold_stands_and_corrects_what_drifts(armed: DynamixelActuator, emulator: ServoEmulator) -> None:
    go(armed, np.full(9, -0.03), 0.3)
    armed.hold()
    held = {motor: found["position"] for motor, found in emulator.report().items()}
    assert speeds(emulator) == [0] * 9
    motor = TENDONS[0]
    emulator.do("turn", motor, position=held[motor] - 400)  # pulled away by the arm's weight
    armed.read()
    assert abs(speeds(emulator)[0] - 0.5 * 400 / (0.229 / 60 * 4096)) < 1.1
    assert speeds(emulator)[1:] == [0] * 8
    within_limits(emulator)


def test_a_hold_stops_motors_that_do_not_answer(armed: DynamixelActuator, emulator: ServoEmulator) -> None:
    go(armed, np.full(9, -0.03), 0.1)
    emulator.do("corrupt", TENDONS[5])  # it hears, and says nothing that can be understood
    with pytest.raises(CommunicationError, match=r"motor 6 \(id 16\)"):
        armed.hold()
    assert speeds(emulator) == [0] * 9
    emulator.do("heal")
    armed.read()  # which corrects the others, but that one was told no place to hold
    assert speeds(emulator)[5] == 0


def test_the_watchdog_stops_motors_that_hear_nothing_before_their_goal(used: ServoEmulator) -> None:
    emulator = used
    with DynamixelActuator(velocity(emulator.link, bus_watchdog=0.4, velocity_gain=2.5)) as actuator:
        actuator.calibrate()
        actuator.arm()
        actuator.read()
        sent = actuator.send(np.array(LOWER))
        time.sleep(0.7)
        with pytest.raises(DeviceFaultError, match=r"motor 1 .*watchdog"):
            actuator.read()
        report = emulator.report()
        ticks = np.array([report[motor]["position"] - POSITIONS[motor] for motor in TENDONS])
        y = np.array(SIGNS) * RADII * 2 * np.pi * ticks / 4096
        assert (y >= sent - 1e-9).all() and (y < -1e-3).all()
        assert all(report[motor]["torque"] for motor in TENDONS)


def test_a_second_at_100_hz(armed: DynamixelActuator, emulator: ServoEmulator) -> None:
    """No exchange fails, and the tendons follow a ramp as far behind it as the gain lets them."""
    behind, last = 0.0, time.monotonic()
    for k in range(100):
        assert np.isfinite(armed.read().y).all()
        armed.send(np.full(9, -5e-5 * k))
        time.sleep(0.01)
        # dy/dt = gain (y_d - y), over the time that this turn took.
        now = time.monotonic()
        behind, last = -5e-5 * k + (behind + 5e-5 * k) * np.exp(-0.5 * (now - last)), now
    assert behind < -0.9e-3
    np.testing.assert_allclose(armed.read().y, behind, rtol=0.2)
    within_limits(emulator)
