"""What connecting refuses."""

from __future__ import annotations

import pytest
from hypothesis import HealthCheck, given
from hypothesis import settings as settings_of
from hypothesis import strategies as st

from apcc_torch.errors import CommunicationError, DeviceFaultError, HardwareError
from apcc_torch.hardware.dynamixel import registers
from apcc_torch.hardware.dynamixel.actuator import DynamixelActuator
from apcc_torch.hardware.dynamixel.bus import DynamixelBus
from apcc_torch.hardware.servos.register import Register
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


def peek(emulator: ServoEmulator, motor: int, register: Register) -> int:
    place = {"address": register.address, "length": register.length, "signed": register.signed}
    return int(emulator.do("peek", motor, **place)["value"])


def poke(emulator: ServoEmulator, motor: int, register: Register, value: int) -> None:
    emulator.do("poke", motor, address=register.address, length=register.length, value=value)


def test_an_offset_of_the_positions_is_refused_and_the_calibration_with_it(emulator: ServoEmulator) -> None:
    actuator = DynamixelActuator(settings(emulator.link))
    with actuator:
        zero = actuator.calibrate()
    poke(emulator, MOTOR, registers.HOMING_OFFSET, -120)
    refused(emulator, HardwareError, r"motor 6 \(id 16\) has homing offset -120, needs 0: .* calibrate again")
    poke(emulator, MOTOR, registers.HOMING_OFFSET, 0)
    with actuator, pytest.raises(HardwareError, match=r"motor 6 \(id 16\) .* calibrate again"):
        actuator.restore(zero)


# What may stand in each register that scales, shifts or limits a motor's motion.
FOUND = {
    registers.RETURN_DELAY: st.integers(0, 254),
    registers.DRIVE_MODE: st.sampled_from([0, 1, 4, 5]),
    registers.OPERATING_MODE: st.sampled_from([0, 1, 3, 4, 5, 16]),
    registers.SECONDARY_ID: st.integers(0, 252),
    registers.PWM_LIMIT: st.integers(0, 885),
    registers.CURRENT_LIMIT: st.integers(0, 1193),
    registers.VELOCITY_LIMIT: st.integers(0, 1023),
    registers.MAX_POSITION_LIMIT: st.integers(0, 4095),
    registers.MIN_POSITION_LIMIT: st.integers(0, 4095),
    registers.STARTUP_CONFIGURATION: st.integers(0, 3),
    registers.SHUTDOWN: st.integers(0, 255),
    registers.POSITION_P_GAIN: st.integers(0, 16_383),
    registers.POSITION_I_GAIN: st.integers(0, 16_383),
    registers.POSITION_D_GAIN: st.integers(0, 16_383),
    registers.FEEDFORWARD_1ST_GAIN: st.integers(0, 16_383),
    registers.FEEDFORWARD_2ND_GAIN: st.integers(0, 16_383),
    registers.GOAL_PWM: st.integers(-885, 885),
    registers.GOAL_CURRENT: st.integers(-1193, 1193),
    registers.PROFILE_VELOCITY: st.integers(0, 32_767),
    registers.PROFILE_ACCELERATION: st.integers(0, 32_767),
}
CHANGES = st.lists(
    st.tuples(st.sampled_from([*TENDONS, GRIPPER]), st.sampled_from(list(FOUND))).flatmap(
        lambda place: FOUND[place[1]].map(lambda value: (*place, value))
    ),
    max_size=30,
)


@settings_of(max_examples=15, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(changes=CHANGES)
def test_whatever_the_registers_hold_an_armed_motor_moves_as_the_settings_say(
    emulator: ServoEmulator, changes: list[tuple[int, Register, int]]
) -> None:
    emulator.do("fresh")
    needed = {}
    with DynamixelActuator(settings(emulator.link)) as actuator:
        actuator.calibrate()
        actuator.arm()
        for motor in (*TENDONS, GRIPPER):
            needed[motor] = {register: peek(emulator, motor, register) for register in FOUND}
    assert all(needed[motor] == needed[TENDONS[0]] for motor in TENDONS)
    for motor, register, value in changes:
        poke(emulator, motor, register, value)
    with DynamixelActuator(settings(emulator.link)) as actuator:
        actuator.calibrate()
        actuator.arm()
        for motor, found in needed.items():
            assert {register: peek(emulator, motor, register) for register in FOUND} == found


def test_a_register_that_is_not_taken_is_named(emulator: ServoEmulator, monkeypatch: pytest.MonkeyPatch) -> None:
    poke(emulator, MOTOR, registers.PWM_LIMIT, 100)
    write = DynamixelBus.write
    monkeypatch.setattr(
        DynamixelBus, "write", lambda self, m, r, v: None if r == registers.PWM_LIMIT else write(self, m, r, v)
    )
    refused(emulator, DeviceFaultError, r"motor 6 \(id 16\) has PWM limit 100, needs 885, and does not take it")
    monkeypatch.undo()
    with DynamixelActuator(settings(emulator.link)) as actuator:
        poke(emulator, MOTOR, registers.PWM_LIMIT, 100)  # somebody else's hand on the bus
        actuator.calibrate()
        with pytest.raises(DeviceFaultError, match=r"goal PWM = 885: motor 6 \(id 16\) says the value is out of range"):
            actuator.arm()
        assert not any(found["torque"] for found in emulator.report().values())
    emulator.do("poke", MOTOR, address=64, length=1, value=1)
    actuator = DynamixelActuator(settings(emulator.link))
    actuator.bus.open()
    with pytest.raises(DeviceFaultError, match=r"has PWM limit 100, needs 885, and refuses it: PWM limit = 885: .*now"):
        actuator.motors.configure()
    actuator.bus.close()


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
