"""The driver on the emulated bus where all is well: what reaches the motors, and what comes back."""

from __future__ import annotations

import logging
import time
from math import pi
from pathlib import Path

import numpy as np
import pytest

from apcc_torch.errors import DataError, HardwareError, SafetyError, ShapeError, ValueRangeError
from apcc_torch.hardware.dynamixel.actuator import DynamixelActuator
from hardware.dynamixel.rig import GRIPPER, LOWER, POSITIONS, RADII, SIGNS, TENDONS, goals_in_limits, settings
from hardware.emulators.servo.emulator import ServoEmulator


def settle(actuator: DynamixelActuator, seconds: float) -> None:
    """Time goes by, with the watchdog fed."""
    end = time.monotonic() + seconds
    while time.monotonic() < end:
        actuator.read()
        time.sleep(0.01)


def peek(emulator: ServoEmulator, motor: int, address: int, length: int) -> int:
    return int(emulator.do("peek", motor, address=address, length=length)["value"])


def test_connecting_sets_the_motors_up_and_leaves_them_without_torque(emulator: ServoEmulator) -> None:
    for motor in (*TENDONS, GRIPPER):
        emulator.do("poke", motor, address=11, length=1, value=3)
    with DynamixelActuator(settings(emulator.link, current_limit=0.5)) as actuator:
        assert actuator.n_tendons == 9
        for motor in (*TENDONS, GRIPPER):
            # Return delay, drive mode, operating mode, torque, bus watchdog.
            assert [peek(emulator, motor, address, 1) for address in (9, 10, 11, 64, 98)] == [0, 0, 5, 0, 0]
        assert peek(emulator, TENDONS[0], 38, 2) == int(0.5 / 2.69e-3)
        assert peek(emulator, GRIPPER, 38, 2) == int(0.3 / 2.69e-3)
        # The first and the last byte of the status block: present current, status return level.
        assert peek(emulator, TENDONS[4], 168, 2) == 126 and peek(emulator, TENDONS[4], 168 + 2 * 13, 2) == 68


def test_what_the_motors_keep_is_not_written_again(emulator: ServoEmulator) -> None:
    for _ in range(2):
        with DynamixelActuator(settings(emulator.link)):
            pass
    # A motor that holds torque refuses these writes: connecting while it does shows that there are none.
    with DynamixelActuator(settings(emulator.link)) as actuator:
        emulator.do("poke", TENDONS[0], address=64, length=1, value=1)
        actuator.motors.configure()


def test_extended_position_mode(emulator: ServoEmulator) -> None:
    with DynamixelActuator(settings(emulator.link, mode="extended_position")):
        assert peek(emulator, TENDONS[0], 11, 1) == 4


def test_calibrate_takes_the_present_lengths_as_zero(emulator: ServoEmulator) -> None:
    with DynamixelActuator(settings(emulator.link)) as actuator:
        with pytest.raises(HardwareError, match="calibrate"):
            actuator.read()
        with pytest.raises(HardwareError, match="calibrate"):
            actuator.arm()
        found = actuator.calibrate()
        assert found["zero_ticks"] == [POSITIONS[motor] for motor in TENDONS]
        assert found["signs"] == list(SIGNS) and found["spool_radii"] == list(RADII)
        assert np.abs(actuator.read().y).max() == 0.0


def test_reading_has_si_units_and_signs(actuator: DynamixelActuator, emulator: ServoEmulator) -> None:
    motor, k = TENDONS[1], 1  # sign -1: positive rotation pulls in
    emulator.do("turn", motor, position=POSITIONS[motor] + 256)
    emulator.do("load", motor, current=100)
    before = time.monotonic()
    reading = actuator.read()
    assert before <= reading.stamp <= time.monotonic()
    assert reading.y[k] == pytest.approx(-RADII[k] * pi / 8)
    # Stall torque over stall current, 100 units of 2.69 mA, on a 10 mm spool.
    assert reading.effort[k] == pytest.approx(3.0 / 2.3 * 0.269 / 0.01)
    assert reading.raw["position"][k] == POSITIONS[motor] + 256 and reading.raw["current"][k] == 100
    emulator.do("load", motor, current=-100)
    assert actuator.read().effort[k] == pytest.approx(-3.0 / 2.3 * 0.269 / 0.01)


@pytest.mark.parametrize("goals", ["left by an earlier program", "following the position"])
def test_arming_moves_nothing(actuator: DynamixelActuator, emulator: ServoEmulator, goals: str) -> None:
    for motor in TENDONS:
        if goals == "following the position":
            emulator.do("track", motor)
        else:
            emulator.do("poke", motor, address=116, length=4, value=0)
    actuator.arm()
    settle(actuator, 0.1)
    for motor, found in emulator.report().items():
        assert found["torque"] == 1 and found["position"] == POSITIONS[motor] == found["goal"]
        assert peek(emulator, motor, 98, 1) == 100
        assert peek(emulator, motor, 102, 2) == peek(emulator, motor, 38, 2)
    with pytest.raises(HardwareError, match="without torque"):
        actuator.arm()
    with pytest.raises(HardwareError, match="without torque"):
        actuator.calibrate()


def test_motors_go_where_they_are_sent(actuator: DynamixelActuator, emulator: ServoEmulator) -> None:
    actuator.arm()
    y = np.linspace(-0.001, -0.009, 9)
    sent = actuator.send(y)
    assert np.abs(sent - y).max() <= 0.5 * 0.02 * 2 * pi / 4096
    assert np.abs(sent - y).max() > 0
    settle(actuator, 0.1)
    assert (actuator.read().ydot < 0).any()
    settle(actuator, 0.6)
    assert np.abs(actuator.read().y - sent).max() < 1e-4
    for k, motor in enumerate(TENDONS):
        ticks = emulator.report()[motor]["goal"] - POSITIONS[motor]
        assert SIGNS[k] * RADII[k] * 2 * pi * ticks / 4096 == pytest.approx(sent[k], abs=1e-12)


def test_send_stays_within_the_limits_and_says_so(actuator: DynamixelActuator, emulator: ServoEmulator) -> None:
    actuator.arm()
    tick = np.array(RADII) * 2 * pi / 4096
    low = actuator.send(np.full(9, -1e12))
    assert (low >= LOWER).all() and (low < np.array(LOWER) + tick).all()
    assert (actuator.send(np.full(9, 1e12)) == 0).all()
    goals_in_limits(emulator)


@pytest.mark.parametrize(
    ("y", "error"),
    [(np.zeros(8), ShapeError), (np.full(9, np.nan), ValueRangeError), (np.full(9, -np.inf), ValueRangeError)],
)
def test_send_refuses_what_is_no_command(
    actuator: DynamixelActuator, emulator: ServoEmulator, y: np.ndarray, error: type[Exception]
) -> None:
    actuator.arm()
    before = len(emulator.report()[TENDONS[0]]["goals"])
    with pytest.raises(error, match="y must"):
        actuator.send(y)
    assert len(emulator.report()[TENDONS[0]]["goals"]) == before


def test_hold_stops_a_motion(actuator: DynamixelActuator, emulator: ServoEmulator) -> None:
    actuator.arm()
    actuator.send(np.full(9, -0.03))
    settle(actuator, 0.1)
    actuator.hold()
    settle(actuator, 0.3)
    held = actuator.read().y
    assert (held < -1e-4).all() and (held > -0.025).all()
    assert all(found["torque"] for found in emulator.report().values())
    goals_in_limits(emulator)


def test_torque_off_twice_and_in_every_state(emulator: ServoEmulator) -> None:
    actuator = DynamixelActuator(settings(emulator.link))
    actuator.torque_off()
    actuator.disconnect()
    for wrong in (actuator.arm, actuator.hold, actuator.calibrate, lambda: actuator.send(np.zeros(9))):
        with pytest.raises(HardwareError, match="connect before"):
            wrong()
    actuator.connect()
    with pytest.raises(HardwareError, match="connected already"):
        actuator.connect()
    actuator.calibrate()
    for wrong in (actuator.hold, lambda: actuator.send(np.zeros(9))):
        with pytest.raises(HardwareError, match="armed"):
            wrong()
    actuator.arm()
    actuator.torque_off()
    actuator.torque_off()
    assert not any(found["torque"] for found in emulator.report().values())
    actuator.arm()
    actuator.disconnect()
    actuator.disconnect()
    assert not any(found["torque"] for found in emulator.report().values())


def test_an_exception_leaves_the_motors_without_torque(emulator: ServoEmulator) -> None:
    def program() -> None:
        with DynamixelActuator(settings(emulator.link)) as actuator:
            actuator.calibrate()
            actuator.arm()
            assert all(found["torque"] for found in emulator.report().values())
            raise ZeroDivisionError

    with pytest.raises(ZeroDivisionError):
        program()
    assert not any(found["torque"] for found in emulator.report().values())


def test_arming_refuses_a_tendon_outside_its_range(actuator: DynamixelActuator, emulator: ServoEmulator) -> None:
    motor = TENDONS[2]
    emulator.do("turn", motor, position=POSITIONS[motor] + 400)  # 6 mm longer than the zero
    with pytest.raises(SafetyError, match=r"motor 3 \(id 13\) is at 6\.1 mm, outside -35 to 0 mm"):
        actuator.arm()
    emulator.do("turn", motor, position=POSITIONS[motor] + 60)  # 0.9 mm is within the tolerance
    actuator.arm()
    assert emulator.report()[motor]["goal"] == POSITIONS[motor]
    goals_in_limits(emulator)


def test_a_calibration_is_restored_by_a_later_program(emulator: ServoEmulator) -> None:
    with DynamixelActuator(settings(emulator.link)) as first:
        found = first.calibrate()
    emulator.do("turn", TENDONS[5], position=POSITIONS[TENDONS[5]] + 500)
    with DynamixelActuator(settings(emulator.link)) as second:
        second.restore(found)
        assert second.read().y[5] == pytest.approx(-0.012 * 2 * pi * 500 / 4096)
        with pytest.raises(DataError, match="ids"):
            second.restore(found | {"ids": [1]})
        with pytest.raises(DataError, match="zero_ticks"):
            second.restore(found | {"zero_ticks": [1, 2]})


def test_a_calibration_from_before_a_restart_is_refused(emulator: ServoEmulator) -> None:
    with DynamixelActuator(settings(emulator.link)) as first:
        found = first.calibrate()
    emulator.do("restart", TENDONS[7])
    for _ in range(2):  # the first connection writes the status block anew: the second must not be fooled
        with DynamixelActuator(settings(emulator.link)) as second, pytest.raises(HardwareError, match="motor 8"):
            second.restore(found)


def test_a_calibration_from_before_another_mode_is_refused(emulator: ServoEmulator) -> None:
    with DynamixelActuator(settings(emulator.link)) as first:
        found = first.calibrate()
    changed = DynamixelActuator(settings(emulator.link, mode="extended_position"))
    with changed as second, pytest.raises(HardwareError, match="calibrate again"):
        second.restore(found)


def test_the_gripper_is_no_tendon(actuator: DynamixelActuator, emulator: ServoEmulator) -> None:
    gripper = actuator.gripper
    assert gripper is not None
    with pytest.raises(HardwareError, match="gripper is not armed"):
        gripper.open()
    actuator.arm()
    assert actuator.read().y.shape == (9,)
    gripper.close()
    assert emulator.report()[GRIPPER]["goal"] == round(2.0 / (2 * pi) * 4096)
    assert gripper.goal(0.5) == pytest.approx(0.5, abs=1e-3)
    assert emulator.report()[GRIPPER]["goal"] == pytest.approx(1.5 / (2 * pi) * 4096, abs=1)
    assert gripper.goal(7.0) == 1.0
    assert emulator.report()[GRIPPER]["goal"] == round(1.0 / (2 * pi) * 4096)
    with pytest.raises(ValueRangeError, match="opening"):
        gripper.goal(float("nan"))
    settle(actuator, 0.8)
    assert gripper.opening() == pytest.approx(1.0, abs=0.01)


def test_a_gripper_beyond_its_ends_is_not_armed(actuator: DynamixelActuator, emulator: ServoEmulator) -> None:
    emulator.do("turn", GRIPPER, position=3000)
    with pytest.raises(SafetyError, match="gripper"):
        actuator.arm()
    assert not any(found["torque"] for found in emulator.report().values())


def test_a_port_without_low_latency_mode_is_said_and_used(
    emulator: ServoEmulator, caplog: pytest.LogCaptureFixture
) -> None:
    with caplog.at_level(logging.DEBUG), DynamixelActuator(settings(emulator.link)):
        assert "low-latency" in caplog.text


def test_five_seconds_at_100_hz(emulator: ServoEmulator) -> None:
    with DynamixelActuator(settings(emulator.link, gripper=None, reply_timeout=1.0)) as actuator:
        actuator.calibrate()
        actuator.arm()
        start = time.monotonic()
        for k in range(500):
            time.sleep(max(0.0, start + 0.01 * k - time.monotonic()))
            reading = actuator.read()
            sent = actuator.send(np.full(9, -0.01 + 0.01 * np.cos(0.02 * pi * k)))
        assert np.abs(reading.y - sent).max() < 0.02
    assert {found["bad_packets"] for found in emulator.report().values()} == {0}
    assert len(emulator.report()[TENDONS[0]]["goals"]) == 502  # two when it was armed
    goals_in_limits(emulator)


def test_no_port(tmp_path: Path) -> None:
    actuator = DynamixelActuator(settings(tmp_path / "nothing"))
    with pytest.raises(HardwareError, match="cannot open the port"):
        actuator.connect()
    actuator.disconnect()
