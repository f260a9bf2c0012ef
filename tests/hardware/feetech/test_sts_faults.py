"""What can go wrong with STS servos and their line, each by its sentence, and what it leaves."""

from __future__ import annotations

import time

import numpy as np
import pytest

from apcc_torch.errors import CommunicationError, DeviceFaultError, HardwareError, ValueRangeError
from apcc_torch.hardware.feetech.actuator import FeetechActuator
from apcc_torch.hardware.feetech.registers import GOAL_POSITION, TORQUE_LIMIT, TORQUE_SWITCH
from apcc_torch.hardware.servos.register import Register
from hardware.emulators.servo.emulator import ServoEmulator
from hardware.feetech.rig import POSITIONS, TENDONS, nothing_forbidden, settings

MOTOR = TENDONS[3]
NAME = r"motor 4 \(id 14\)"
PULL = np.full(9, -0.02)


def torqued(emulator: ServoEmulator) -> set[int]:
    return {motor for motor, found in emulator.report().items() if found["torque"]}


@pytest.mark.parametrize(
    ("address", "length", "value", "said"),
    [
        (3, 2, 2825, "is model 2825, not 777"),
        (31, 2, 100, "has position offset 100, needs 0: set it with Feetech's own tool and calibrate again"),
        (65, 1, 32, "reports overload: turn its power off and on"),
        (65, 1, 4, "reports overheating: turn its power off and on"),
        (40, 1, 1, "holds torque already; release_torqued=true lets go"),
        (40, 1, 2, "holds torque already"),  # it brakes
    ],
)
def test_what_connecting_refuses(emulator: ServoEmulator, address: int, length: int, value: int, said: str) -> None:
    emulator.do("poke", MOTOR, address=address, length=length, value=value)
    actuator = FeetechActuator(settings(emulator.link))
    with pytest.raises(HardwareError, match=f"^{NAME} {said}"):
        actuator.connect()
    assert not actuator.bus.is_open and not any(found["goals"] for found in emulator.report().values())


def test_a_servo_that_holds_torque_is_let_go_where_that_is_asked_for(emulator: ServoEmulator) -> None:
    emulator.do("poke", MOTOR, address=40, length=1, value=1)
    with FeetechActuator(settings(emulator.link, release_torqued=True)):
        assert torqued(emulator) == set()


def test_a_missing_servo(emulator: ServoEmulator) -> None:
    emulator.do("mute", MOTOR)
    with pytest.raises(CommunicationError, match=f"^{NAME}: no reply"):
        FeetechActuator(settings(emulator.link, reply_timeout=0.1)).connect()


@pytest.mark.parametrize(
    ("fault", "amount", "said"),
    [
        ("mute", 1, "no reply"),
        ("corrupt", 1, "corrupt reply"),
        ("cut", 5, "corrupt reply"),
        ("short", 2, "reply with 29 bytes of data instead of 31"),
        ("short", 31, "reply with 0 bytes of data instead of 31"),
    ],
)
def test_spoilt_replies(armed: FeetechActuator, emulator: ServoEmulator, fault: str, amount: int, said: str) -> None:
    emulator.do(fault, MOTOR, count=1, amount=amount)
    with pytest.raises(CommunicationError, match=f"{NAME}: {said}"):
        armed.read()
    assert armed.read().raw["position"] == [POSITIONS[motor] for motor in TENDONS]
    assert torqued(emulator) == set(TENDONS)


def test_a_late_reply_is_not_taken_for_the_next(armed: FeetechActuator, emulator: ServoEmulator) -> None:
    emulator.do("late", MOTOR, count=1, amount=1.4)
    with pytest.raises(CommunicationError, match=NAME):
        armed.read()
    emulator.do("load", MOTOR, current=77)
    time.sleep(0.8)
    assert armed.read().raw["current"][3] == 77


def test_an_overload_and_a_limit_that_is_lost(armed: FeetechActuator, emulator: ServoEmulator) -> None:
    armed.send(PULL)
    emulator.do("poke", MOTOR, address=48, length=2, value=200)
    with pytest.raises(DeviceFaultError, match=f"^{NAME} has torque limit 200 instead of 400"):
        armed.read()
    emulator.do("overload", MOTOR)
    with pytest.raises(DeviceFaultError, match=f"^{NAME} reports overload$"):
        armed.read()
    with pytest.raises(DeviceFaultError, match="overload"):
        armed.hold()
    held = emulator.report()[TENDONS[0]]
    assert abs(held["goal"] - held["position"]) < 100  # where it was, not where it was sent
    armed.torque_off()
    assert torqued(emulator) == set()


@pytest.mark.parametrize("arm", [False, True])
def test_a_restart_loses_the_zero(actuator: FeetechActuator, emulator: ServoEmulator, arm: bool) -> None:
    if arm:
        actuator.arm()
    emulator.do("restart", MOTOR)
    with pytest.raises(DeviceFaultError, match=f"^{NAME} has restarted and lost its zero: connect and calibrate again"):
        actuator.read()
    actuator.torque_off()
    with pytest.raises(HardwareError, match="calibrate"):
        actuator.arm()
    emulator.do("turn", MOTOR, position=POSITIONS[MOTOR])  # for the check of the goals that were sent


def test_positions_that_run_over_their_bits_are_a_jump(armed: FeetechActuator, emulator: ServoEmulator) -> None:
    """At 32768 ticks a position begins anew from below: the zero is lost, and nothing is sent on it."""
    emulator.do("turn", MOTOR, position=32_800)
    with pytest.raises(DeviceFaultError, match=f"^{NAME} jumped by .* ticks and lost its zero: calibrate again"):
        armed.read()
    before = emulator.report()[MOTOR]["goals"]
    for wrong in (lambda: armed.send(PULL), armed.read, armed.hold):
        with pytest.raises(HardwareError, match=f"{NAME} lost its zero"):
            wrong()
    assert emulator.report()[MOTOR]["goals"] == before


def test_unplugged_and_plugged_in_again(armed: FeetechActuator, emulator: ServoEmulator) -> None:
    emulator.do("unplug")
    for use in (armed.read, lambda: armed.send(PULL)):
        with pytest.raises(CommunicationError, match="lost the port"):
            use()
    with pytest.raises(CommunicationError, match=r"not confirmed by motor 1 .* motor 9 .*: cut the power"):
        armed.torque_off()
    armed.disconnect()
    emulator.do("plug")
    with pytest.raises(HardwareError, match=r"motor 1 .* holds torque already"):
        armed.connect()


def test_arming_is_all_or_nothing(actuator: FeetechActuator, emulator: ServoEmulator) -> None:
    write = actuator.bus.write

    def losing(motor: int, register: Register, value: int) -> None:
        if register is not TORQUE_LIMIT or motor != MOTOR:
            write(motor, register, value)

    actuator.bus.write = losing  # type: ignore[method-assign]
    with pytest.raises(DeviceFaultError, match=f"^{NAME} has torque limit 1000, needs 400"):
        actuator.arm()
    assert torqued(emulator) == set()

    def silent(motor: int, register: Register, value: int) -> None:
        if register is TORQUE_SWITCH and motor == MOTOR and value:
            emulator.do("mute", motor, count=2)
        write(motor, register, value)

    actuator.bus.write = silent  # type: ignore[method-assign]
    with pytest.raises(CommunicationError, match=NAME):
        actuator.arm()
    actuator.bus.write = write  # type: ignore[method-assign]
    assert torqued(emulator) == set()


def test_a_goal_that_is_not_the_present_position_is_not_armed(
    actuator: FeetechActuator, emulator: ServoEmulator
) -> None:
    write = actuator.bus.write

    def losing(motor: int, register: Register, value: int) -> None:
        if register is not GOAL_POSITION or motor != MOTOR:
            write(motor, register, value)

    emulator.do("poke", MOTOR, address=42, length=2, value=0)
    actuator.bus.write = losing  # type: ignore[method-assign]
    with pytest.raises(DeviceFaultError, match=f"^{NAME} has goal 0 instead of {POSITIONS[MOTOR]}"):
        actuator.arm()
    actuator.bus.write = write  # type: ignore[method-assign]


def test_the_middle_of_an_encoder_is_never_moved(actuator: FeetechActuator, emulator: ServoEmulator) -> None:
    """128 in the torque switch would do that, for good."""
    for use in (
        lambda: actuator.bus.write(MOTOR, TORQUE_SWITCH, 128),
        lambda: actuator.bus.sync_write(TORQUE_SWITCH, {MOTOR: 128}),
    ):
        with pytest.raises(ValueRangeError, match="torque switch must be 0 or 1, got 128"):
            use()
    nothing_forbidden(emulator)
