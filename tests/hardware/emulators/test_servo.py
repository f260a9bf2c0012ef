"""The emulated servo itself: packets as the maker's example and SDK have them, motion and watchdog in closed form."""

from __future__ import annotations

from math import exp

import pytest
from dynamixel_sdk import Protocol2PacketHandler
from hypothesis import given
from hypothesis import strategies as st

from hardware.emulators.servo.motor import DATA_RANGE, GAIN, OK, TICKS_PER_SPEED_UNIT, Motor
from hardware.emulators.servo.packet import Instruction, Parser, crc16, frame, status, stuff, unstuff

BYTES = st.lists(st.sampled_from([0x00, 0x55, 0xFD, 0xFF]), max_size=40).map(bytes)


def test_the_makers_example() -> None:
    # Ping of motor 1, and its answer: model 1030, firmware 38.
    assert frame(1, b"\x01") == bytes.fromhex("FF FF FD 00 01 03 00 01 19 4E")
    assert status(1, 0, b"\x06\x04\x26") == bytes.fromhex("FF FF FD 00 01 07 00 55 00 06 04 26 65 5D")


@given(data=st.binary(max_size=60))
def test_the_checksum_is_the_sdks(data: bytes) -> None:
    assert crc16(data) == Protocol2PacketHandler().updateCRC(0, data, len(data))


@given(body=BYTES)
def test_stuffed_bytes_hold_no_header_and_come_back(body: bytes) -> None:
    assert b"\xff\xff\xfd\x00" not in stuff(body) + b"\x00"
    assert unstuff(stuff(body)) == body


@given(body=BYTES, cut=st.integers(1, 30))
def test_packets_are_found_in_pieces(body: bytes, cut: int) -> None:
    stream = frame(7, b"\x03" + body) + frame(8, b"\x01")
    parser = Parser()
    found = parser.feed(stream[:cut]) + parser.feed(stream[cut:])
    assert found == [Instruction(7, 3, body), Instruction(8, 1, b"")] and parser.bad == 0
    broken = bytearray(frame(7, b"\x03" + body))
    broken[-1] ^= 1
    parser = Parser()
    assert parser.feed(bytes(broken)) == [] and parser.bad == 1


def moving(watchdog: int) -> Motor:
    """A motor that is on its way to tick 4000 with profile velocity 100, from time 0."""
    motor = Motor(1, 0, 0.0)
    for address, length, value in ((112, 4, 100), (98, 1, watchdog), (116, 4, 4000), (64, 1, 1)):
        assert motor.write(address, value.to_bytes(length, "little"), 0.0) == OK
    return motor


def test_motion_is_straight_and_then_of_first_order() -> None:
    top = 100 * TICKS_PER_SPEED_UNIT
    motor = moving(0)
    motor.advance(1.0)
    assert motor.position == pytest.approx(top)
    corner = (4000 - top / GAIN) / top
    motor.advance(corner + 0.05)
    assert motor.position == pytest.approx(4000 - top / GAIN * exp(-GAIN * 0.05))


def test_the_watchdog_stops_it_on_time_and_refuses_goals_until_it_is_cleared() -> None:
    motor = moving(5)
    motor.advance(0.099)
    assert motor.memory[98] == 5
    motor.advance(3.0)
    assert motor.memory[98] == 0xFF and motor.memory[64] == 1
    assert motor.position == pytest.approx(100 * TICKS_PER_SPEED_UNIT * 0.1)
    assert motor.write(116, (5).to_bytes(4, "little"), 3.0) == DATA_RANGE and motor.refused == 1
    assert motor.write(98, b"\x00", 3.0) == OK
    assert motor.write(116, (5).to_bytes(4, "little"), 3.0) == OK


def test_it_tells_how_long_it_held_torque_after_its_last_goal() -> None:
    motor = moving(0)
    assert motor.held is None
    motor.write(116, (5).to_bytes(4, "little"), 2.0)
    for now in (3.5, 9.0):  # told to let go twice: the first time counts
        motor.write(64, b"\x00", now)
        assert motor.held == 1.5
    motor.write(64, b"\x01", 10.0)
    assert motor.held is None


def test_a_restart_keeps_the_turn_and_loses_the_count() -> None:
    motor = Motor(1, 3 * 4096 + 5, 0.0)
    motor.write(168, (132).to_bytes(2, "little"), 0.0)
    motor.restart(1.0)
    assert motor.position == 5 and motor.get(168, 2) == 224 and motor.memory[11] == 5
