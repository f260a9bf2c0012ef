"""The driver of STS servos on the emulated bus where all is well: set-up, units, signs, limits, calibrations."""

from __future__ import annotations

import time
from math import pi

import numpy as np
import pytest

from apcc_torch.errors import ConfigError, DataError, HardwareError, SafetyError, ShapeError, ValueRangeError
from apcc_torch.hardware.feetech.actuator import FeetechActuator
from hardware.emulators.servo.emulator import ServoEmulator
from hardware.feetech.rig import LOWER, POSITIONS, RADII, SIGNS, TENDONS, nothing_forbidden, settings

KG_CM = 0.0980665  # N m


def peek(emulator: ServoEmulator, motor: int, address: int, length: int = 1) -> int:
    return int(emulator.do("peek", motor, address=address, length=length)["value"])


def settle(actuator: FeetechActuator, seconds: float) -> None:
    end = time.monotonic() + seconds
    while time.monotonic() < end:
        actuator.read()
        time.sleep(0.01)


def test_connecting_sets_up_for_good_and_locks_again(emulator: ServoEmulator) -> None:
    """As from the factory: positions of one turn. What is written outlives a restart, and torque stays off."""
    for motor in TENDONS:
        for address, length, value in ((11, 2, 4095), (18, 1, 12), (33, 1, 1), (19, 1, 0)):
            emulator.do("poke", motor, address=address, length=length, value=value)
    with FeetechActuator(settings(emulator.link, position_gains=(40, 1, 20))):
        pass
    for motor in TENDONS:
        emulator.do("restart", motor)
        assert (peek(emulator, motor, 9, 2), peek(emulator, motor, 11, 2)) == (0, 0)
        assert peek(emulator, motor, 18) == 12 | 16, "the other bits of the phase are its own"
        assert peek(emulator, motor, 33) == 0 and peek(emulator, motor, 19) & 0b101100 == 0b101100
        assert [peek(emulator, motor, address) for address in (21, 23, 22)] == [40, 1, 20]
        assert peek(emulator, motor, 55) == 1 and peek(emulator, motor, 40) == 0
    nothing_forbidden(emulator)


def test_a_servo_that_answers_readings_alone_is_made_to_answer(emulator: ServoEmulator) -> None:
    emulator.do("poke", TENDONS[2], address=8, length=1, value=0)
    with FeetechActuator(settings(emulator.link)):
        assert peek(emulator, TENDONS[2], 8) == 1 and peek(emulator, TENDONS[2], 55) == 1


def test_what_the_servos_have_already_is_not_written(emulator: ServoEmulator) -> None:
    """EEPROM wears: with all as it should be the lock stays closed, which a restart then shows."""
    with FeetechActuator(settings(emulator.link)):
        pass
    emulator.do("poke", TENDONS[0], address=19, length=1, value=63)  # more protections than are asked for
    with FeetechActuator(settings(emulator.link)):
        assert peek(emulator, TENDONS[0], 19) == 63


def test_reading_has_si_units_and_signs(actuator: FeetechActuator, emulator: ServoEmulator) -> None:
    motor, k = TENDONS[1], 1  # sign -1: positive rotation pulls in
    emulator.do("turn", motor, position=POSITIONS[motor] + 256)
    emulator.do("load", motor, current=100)
    reading = actuator.read()
    assert reading.y[k] == pytest.approx(-RADII[k] * pi / 8)
    assert reading.effort[k] == pytest.approx(100 * 6.5e-3 * 11 * KG_CM / RADII[k], rel=1e-3)
    assert reading.raw["position"][k] == POSITIONS[motor] + 256 and reading.raw["load"][k] == 100
    emulator.do("load", motor, current=-100)  # the load's sign is bit 10, and the current has none here
    assert actuator.read().effort[k] == pytest.approx(-100 * 6.5e-3 * 11 * KG_CM / RADII[k], rel=1e-3)
    assert actuator.read().raw["load"][k] == -100


@pytest.mark.parametrize(("phase", "unit"), [(12 | 16, 0.0146), (8 | 16, 0.732)])
def test_both_units_of_speed(emulator: ServoEmulator, phase: int, unit: float) -> None:
    for motor in TENDONS:
        emulator.do("poke", motor, address=18, length=1, value=phase)
    with FeetechActuator(settings(emulator.link, profile_velocity=2.0)) as actuator:
        actuator.calibrate()
        actuator.arm()
        told = peek(emulator, TENDONS[0], 46, 2)
        assert 2.0 - unit * pi / 30 <= told * unit * pi / 30 <= 2.0
        actuator.send(np.full(9, -0.02))
        settle(actuator, 0.15)
        speed = np.abs(actuator.read().ydot / RADII)
        assert (np.abs(speed - 2.0) < 0.2).all()


@pytest.mark.parametrize("goals", ["left by an earlier program", "following the position"])
def test_arming_moves_nothing(actuator: FeetechActuator, emulator: ServoEmulator, goals: str) -> None:
    for motor in TENDONS:
        if goals == "following the position":
            emulator.do("track", motor)
        else:
            emulator.do("poke", motor, address=42, length=2, value=0)
    actuator.arm()
    settle(actuator, 0.1)
    for motor, found in emulator.report().items():
        assert found["torque"] == 1 and found["position"] == POSITIONS[motor] == found["goal"]
        assert peek(emulator, motor, 48, 2) == 400 and peek(emulator, motor, 41) == int(30 / (100 * 2 * pi / 4096))


def test_tendons_go_where_they_are_sent_across_turns_and_zero(armed: FeetechActuator, emulator: ServoEmulator) -> None:
    y = np.linspace(-0.034, -0.06, 9).clip(np.array(LOWER))
    sent = armed.send(y)
    tick = np.array(RADII) * 2 * pi / 4096
    assert (np.abs(sent - y) <= tick).all()
    settle(armed, 2.0)
    assert np.abs(armed.read().y - sent).max() < 1e-4
    for k, motor in enumerate(TENDONS):
        ticks = emulator.report()[motor]["goal"] - POSITIONS[motor]
        assert SIGNS[k] * tick[k] * ticks == pytest.approx(sent[k], abs=1e-12)


def test_a_second_at_100_hz(armed: FeetechActuator) -> None:
    """No exchange fails, and the tendons follow a ramp."""
    for k in range(100):
        assert np.isfinite(armed.read().y).all()
        sent = armed.send(np.full(9, -1e-4 * k))
        time.sleep(0.01)
    settle(armed, 0.3)
    assert np.abs(armed.read().y - sent).max() < 2e-4


def test_send_stays_within_the_limits_and_refuses_what_is_no_command(armed: FeetechActuator) -> None:
    tick = np.array(RADII) * 2 * pi / 4096
    low = armed.send(np.full(9, -1e12))
    assert (low >= LOWER).all() and (low < np.array(LOWER) + tick).all()
    assert (armed.send(np.full(9, 1e12)) == 0).all()
    with pytest.raises(ShapeError, match="y must have shape"):
        armed.send(np.zeros(8))
    with pytest.raises(ValueRangeError, match="y must be finite"):
        armed.send(np.full(9, np.nan))


def test_hold_stops_a_motion_and_torque_off_lets_go(armed: FeetechActuator, emulator: ServoEmulator) -> None:
    armed.send(np.full(9, -0.03))
    settle(armed, 0.1)
    armed.hold()
    settle(armed, 0.2)
    held = armed.read().y
    assert (held < -1e-4).all() and (held > -0.025).all()
    assert all(found["torque"] for found in emulator.report().values())
    for _ in range(2):
        armed.torque_off()
        assert not any(found["torque"] for found in emulator.report().values())


def test_a_zero_too_far_from_the_encoders_is_refused(emulator: ServoEmulator) -> None:
    """Goals reach seven turns: a servo that would have to go beyond them is to be switched off and on."""
    emulator.do("turn", TENDONS[0], position=-7 * 4096 + 100)
    with (
        FeetechActuator(settings(emulator.link)) as actuator,
        pytest.raises(ValueRangeError, match=r"tendon 1 would leave the motor's range of 28672 ticks: turn the power"),
    ):
        actuator.calibrate()


def test_arming_refuses_a_tendon_outside_its_range(actuator: FeetechActuator, emulator: ServoEmulator) -> None:
    motor = TENDONS[2]
    emulator.do("turn", motor, position=POSITIONS[motor] + 400)  # 6 mm longer than the zero
    with pytest.raises(SafetyError, match=r"motor 3 \(id 13\) is at 6\.1 mm, outside -35 to 0 mm"):
        actuator.arm()


def test_a_calibration_holds_as_long_as_the_power(emulator: ServoEmulator) -> None:
    with FeetechActuator(settings(emulator.link)) as first:
        found = first.calibrate()
    emulator.do("turn", TENDONS[5], position=POSITIONS[TENDONS[5]] + 500)
    with FeetechActuator(settings(emulator.link)) as second:
        second.restore(found)
        assert second.read().y[5] == pytest.approx(-0.012 * 2 * pi * 500 / 4096)
        with pytest.raises(DataError, match="ids"):
            second.restore(found | {"ids": [1]})
    emulator.do("restart", TENDONS[7])
    for _ in range(2):  # the first connection takes the servo up again: the second must not be fooled
        with FeetechActuator(settings(emulator.link)) as later, pytest.raises(HardwareError, match=r"^motor 8 .* lost"):
            later.restore(found)
    with FeetechActuator(settings(emulator.link)) as third:
        third.calibrate()
        with pytest.raises(HardwareError, match=r"motor 1 .* or has a newer one: calibrate again"):
            third.restore(found)


def test_a_servo_whose_positions_mean_something_else_loses_its_calibration(emulator: ServoEmulator) -> None:
    with FeetechActuator(settings(emulator.link)) as first:
        found = first.calibrate()
    emulator.do("poke", TENDONS[4], address=18, length=1, value=12)  # positions of one turn
    with FeetechActuator(settings(emulator.link)) as second, pytest.raises(HardwareError, match=r"^motor 5 \(id 15\)"):
        second.restore(found)


@pytest.mark.parametrize(
    ("key", "value"),
    [
        ("model_number", 1284),  # an SCS servo: its bytes are the other way round
        ("torque_limit", 0.0),
        ("torque_limit", 1.2),
        ("profile_velocity", 0.0),
        ("profile_velocity", 0.05),  # less than a unit of some servos: rounded to as fast as they can
        ("profile_acceleration", 0.0),
        ("profile_acceleration", 50.0),
        ("position_gains", (32, 0)),
        ("position_gains", (32, 0, 255)),
        ("torque_constant", 0.0),
        ("baud", 2_000_000),
        ("ids", (1,) * 9),
    ],
)
def test_settings_without_meaning_are_refused_by_name(key: str, value: object) -> None:
    with pytest.raises((ConfigError, ValueRangeError), match=f"^{key} must"):
        settings("/dev/ttyACM0", **{key: value})  # type: ignore[arg-type]


def test_a_baud_rate_that_is_none(emulator: ServoEmulator) -> None:
    with pytest.raises(HardwareError, match="no baud rate 123456"):
        FeetechActuator(settings(emulator.link, baud=123_456)).connect()
