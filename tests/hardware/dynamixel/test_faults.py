"""Faults while the motors hold torque: what is raised, whom it names, and how the motors end."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from apcc_torch.errors import CommunicationError, DeviceFaultError, HardwareError
from apcc_torch.hardware.dynamixel.actuator import DynamixelActuator
from apcc_torch.hardware.dynamixel.registers import GOAL_POSITION, TORQUE_ENABLE
from apcc_torch.hardware.servos.register import Register
from hardware.dynamixel.rig import GRIPPER, POSITIONS, TENDONS, goals_in_limits, settings
from hardware.emulators.servo.emulator import ServoEmulator

MOTOR = TENDONS[3]
NAME = r"motor 4 \(id 14\)"
PULL = np.full(9, -0.02)


@pytest.fixture
def armed(actuator: DynamixelActuator, emulator: ServoEmulator) -> Iterator[DynamixelActuator]:
    """Armed, and after the test let go and checked: no fault may have sent a goal outside the limits."""
    actuator.arm()
    yield actuator
    actuator.disconnect()
    goals_in_limits(emulator)


def torqued(emulator: ServoEmulator) -> set[int]:
    return {motor for motor, found in emulator.report().items() if found["torque"]}


ALL = {*TENDONS, GRIPPER}


def test_a_mute_motor(armed: DynamixelActuator, emulator: ServoEmulator) -> None:
    emulator.do("mute", MOTOR)
    with pytest.raises(CommunicationError, match=f"^{NAME}: no reply$"):
        armed.read()
    armed.send(PULL)
    with pytest.raises(CommunicationError, match=NAME):
        armed.hold()
    assert torqued(emulator) == ALL  # the others are held, near where they were
    with pytest.raises(CommunicationError, match=f"^torque off is not confirmed by {NAME}: cut the power$"):
        armed.torque_off()
    assert torqued(emulator) == {MOTOR}
    emulator.do("heal")
    armed.torque_off()
    assert torqued(emulator) == set()


def test_one_lost_reply_is_one_error(armed: DynamixelActuator, emulator: ServoEmulator) -> None:
    emulator.do("mute", MOTOR, count=1)
    with pytest.raises(CommunicationError, match=NAME):
        armed.read()
    assert np.abs(armed.read().y).max() == 0


@pytest.mark.parametrize(
    ("fault", "amount", "said"),
    [
        ("corrupt", 1, "corrupt reply"),
        ("cut", 5, "corrupt reply"),
        # Of a reply short by two bytes the SDK returns the checksum as data.
        ("short", 2, "12 bytes of data instead of 14"),
        ("short", 1, "13 bytes of data instead of 14"),
        ("short", 14, "0 bytes of data instead of 14"),
    ],
)
def test_spoilt_replies(armed: DynamixelActuator, emulator: ServoEmulator, fault: str, amount: int, said: str) -> None:
    emulator.do(fault, MOTOR, count=1, amount=amount)
    with pytest.raises(CommunicationError, match=said) as caught:
        armed.read()
    assert "motor 4 (id 14)" in str(caught.value)
    reading = armed.read()
    assert reading.raw["position"] == [POSITIONS[motor] for motor in TENDONS]
    assert torqued(emulator) == ALL


def test_a_late_reply_is_not_taken_for_the_next(armed: DynamixelActuator, emulator: ServoEmulator) -> None:
    emulator.do("late", MOTOR, count=1, amount=1.0)
    with pytest.raises(CommunicationError, match=NAME):
        armed.read()
    emulator.do("load", MOTOR, current=77)
    time.sleep(0.5)
    assert armed.read().raw["current"][3] == 77


@pytest.mark.parametrize(
    ("bit", "name"),
    [(0, "input voltage"), (2, "overheating"), (3, "motor encoder"), (4, "electrical shock"), (5, "overload")],
)
def test_hardware_error_bits(armed: DynamixelActuator, emulator: ServoEmulator, bit: int, name: str) -> None:
    emulator.do("poke", MOTOR, address=70, length=1, value=1 << bit)
    with pytest.raises(DeviceFaultError, match=f"^{NAME} reports {name}$"):
        armed.read()


def test_overload(armed: DynamixelActuator, emulator: ServoEmulator) -> None:
    armed.send(PULL)
    emulator.do("overload", MOTOR)
    with pytest.raises(DeviceFaultError, match=f"{NAME} reports overload, and has let go"):
        armed.read()
    with pytest.raises(DeviceFaultError, match="overload"):
        armed.hold()
    assert torqued(emulator) == ALL - {MOTOR}
    held = emulator.report()[TENDONS[0]]
    assert abs(held["goal"] - held["position"]) < 60  # where it was, not where it was sent
    armed.torque_off()
    assert torqued(emulator) == set()
    with pytest.raises(DeviceFaultError, match="overload"):
        armed.arm()
    assert torqued(emulator) == set()


def test_a_tripped_watchdog_is_silent_until_the_next_reading(armed: DynamixelActuator, emulator: ServoEmulator) -> None:
    emulator.do("trip", MOTOR)
    armed.send(PULL)
    assert emulator.report()[MOTOR]["refused"] == 1
    with pytest.raises(DeviceFaultError, match=f"{NAME} has stopped: its bus watchdog tripped"):
        armed.read()
    with pytest.raises(DeviceFaultError, match="watchdog"):
        armed.hold()
    armed.torque_off()
    assert torqued(emulator) == set()
    armed.arm()
    armed.send(np.full(9, -0.001))
    armed.read()
    assert emulator.report()[MOTOR]["goal"] != POSITIONS[MOTOR]


def test_the_watchdog_stops_motors_that_hear_nothing(emulator: ServoEmulator) -> None:
    with DynamixelActuator(settings(emulator.link, bus_watchdog=0.4)) as actuator:
        actuator.calibrate()
        actuator.arm()
        actuator.send(np.full(9, -0.035))
        time.sleep(0.6)
        with pytest.raises(DeviceFaultError, match=r"motor 1 .*, motor 9 .*, gripper .*watchdog"):
            actuator.read()
        assert all(found["tripped"] for found in emulator.report().values())
        first, second = emulator.report(), emulator.report()
        assert all(first[motor]["position"] == second[motor]["position"] != POSITIONS[motor] for motor in TENDONS)


@pytest.mark.parametrize("arm", [False, True])
def test_a_restart_loses_the_zero(actuator: DynamixelActuator, emulator: ServoEmulator, arm: bool) -> None:
    if arm:
        actuator.arm()
    emulator.do("restart", MOTOR)
    with pytest.raises(DeviceFaultError, match=f"^{NAME} has restarted and lost its zero"):
        actuator.read()
    actuator.torque_off()
    with pytest.raises(HardwareError, match="calibrate"):
        actuator.arm()
    with pytest.raises(DeviceFaultError, match="connect and calibrate"):
        actuator.calibrate()
    actuator.disconnect()
    actuator.connect()
    actuator.calibrate()
    actuator.arm()
    assert actuator.read().y[3] == 0


def test_a_jump_loses_the_zero(armed: DynamixelActuator, emulator: ServoEmulator) -> None:
    armed.send(np.full(9, -0.001))
    armed.read()
    emulator.do("turn", MOTOR, position=POSITIONS[MOTOR] - 3 * 4096)
    with pytest.raises(DeviceFaultError, match=f"{NAME} jumped by 12.* ticks and lost its zero"):
        armed.read()
    for wrong in (lambda: armed.send(PULL), armed.read, armed.hold):
        with pytest.raises(HardwareError, match=f"{NAME} lost its zero: calibrate again"):
            wrong()
    goal = {motor: found["goal"] for motor, found in emulator.report().items()}
    emulator.do("turn", TENDONS[0], position=POSITIONS[TENDONS[0]] - 300)
    with pytest.raises(HardwareError, match=NAME):
        armed.hold()  # holds the others where they are
    assert emulator.report()[MOTOR]["goal"] == goal[MOTOR]
    assert abs(emulator.report()[TENDONS[0]]["goal"] - goal[TENDONS[0]]) > 100
    armed.torque_off()
    armed.calibrate()
    assert armed.read().y[3] == 0
    emulator.do("turn", MOTOR, position=POSITIONS[MOTOR])  # for the check of the goals that were sent


def test_lost_torque_and_lost_watchdog(armed: DynamixelActuator, emulator: ServoEmulator) -> None:
    emulator.do("poke", MOTOR, address=98, length=1, value=0)
    with pytest.raises(DeviceFaultError, match=f"{NAME} has bus watchdog 0 instead of 100"):
        armed.read()
    emulator.do("poke", MOTOR, address=64, length=1, value=0)
    with pytest.raises(DeviceFaultError, match=f"{NAME} has lost its torque"):
        armed.read()


def test_unplugged_and_plugged_in_again(armed: DynamixelActuator, emulator: ServoEmulator) -> None:
    emulator.do("unplug")
    for _ in range(2):
        with pytest.raises(CommunicationError, match="lost the port"):
            armed.read()
    with pytest.raises(CommunicationError, match="lost the port"):
        armed.send(PULL)
    with pytest.raises(CommunicationError, match=r"not confirmed by motor 1 .* motor 9 .* gripper"):
        armed.torque_off()
    assert torqued(emulator) == ALL
    armed.disconnect()
    emulator.do("plug")
    with pytest.raises(HardwareError, match=r"motor 1 .* holds torque already; release_torqued"):
        armed.connect()
    assert torqued(emulator) == ALL
    released = DynamixelActuator(settings(emulator.link, release_torqued=True))
    with released as again:
        assert torqued(emulator) == set()
        again.calibrate()
        again.read()


@pytest.mark.parametrize("k", [0, 8, 9])
def test_arming_is_all_or_nothing(actuator: DynamixelActuator, emulator: ServoEmulator, k: int) -> None:
    motor = (*TENDONS, GRIPPER)[k]
    write = actuator.bus.write

    def until_torque(motor_: int, register: Register, value: int) -> None:
        if register is TORQUE_ENABLE and motor_ == motor:
            emulator.do("mute", motor, count=2)
        write(motor_, register, value)

    actuator.bus.write = until_torque
    with pytest.raises(CommunicationError, match=f"id {motor}"):
        actuator.arm()
    actuator.bus.write = write
    assert torqued(emulator) == set()


def test_arming_refuses_a_goal_that_is_not_the_present_position(
    actuator: DynamixelActuator, emulator: ServoEmulator
) -> None:
    write = actuator.bus.write

    def drop_goal(motor: int, register: Register, value: int) -> None:
        if register is not GOAL_POSITION or motor != MOTOR:
            write(motor, register, value)

    actuator.bus.write = drop_goal
    with pytest.raises(DeviceFaultError, match=f"{NAME} has goal 0 instead of {POSITIONS[MOTOR]}"):
        actuator.arm()
    assert all(found["position"] == POSITIONS[motor] for motor, found in emulator.report().items())


def test_kill_9_leaves_the_motors_stopped(emulator: ServoEmulator) -> None:
    script = Path(__file__).with_name("run_until_killed.py")
    environment = os.environ | {"PYTHONPATH": str(script.parents[2])}
    with subprocess.Popen([sys.executable, script, emulator.link], stdout=subprocess.PIPE, env=environment) as driver:
        assert driver.stdout is not None and driver.stdout.readline() == b"moving\n"
        assert torqued(emulator) == ALL
        driver.send_signal(signal.SIGKILL)
        driver.wait()
    time.sleep(0.7)
    first = emulator.report()
    time.sleep(0.1)
    second = emulator.report()
    for motor in TENDONS:
        assert first[motor]["tripped"] and first[motor]["torque"]
        assert first[motor]["position"] == second[motor]["position"]
        assert abs(first[motor]["position"] - first[motor]["goal"]) > 100  # stopped on the way
    goals_in_limits(emulator)
