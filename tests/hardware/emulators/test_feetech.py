"""The emulated STS servo: packets as the maker's SDK has them, its lock, its signs, its motion."""

from __future__ import annotations

from math import exp

import pytest
from hypothesis import given
from hypothesis import strategies as st
from scservo_sdk import SMS_STS_GOAL_POSITION_L, SMS_STS_LOCK, SMS_STS_PRESENT_CURRENT_L, protocol_packet_handler

from apcc_torch.hardware.feetech import registers
from hardware.emulators.feetech.motor import GAIN, Motor, magnitude, number
from hardware.emulators.feetech.packet import Instruction, Parser, frame


class Wire:
    """What the SDK writes."""

    is_using = False

    def clearPort(self) -> None: ...

    def writePort(self, packet: list[int]) -> int:
        self.sent = bytes(packet)
        return len(packet)


@given(identity=st.integers(0, 253), address=st.integers(0, 100), data=st.binary(min_size=1, max_size=30))
def test_packets_are_the_sdks(identity: int, address: int, data: bytes) -> None:
    wire = Wire()
    protocol_packet_handler(wire, 0).writeTxOnly(identity, address, len(data), list(data))
    assert wire.sent == frame(identity, 3, bytes([address]) + data)
    assert Parser().feed(wire.sent) == [Instruction(identity, 3, bytes([address]) + data)]


@given(data=st.binary(max_size=30), cut=st.integers(1, 30))
def test_packets_are_found_in_pieces_and_spoilt_ones_are_not(data: bytes, cut: int) -> None:
    stream = frame(7, 3, data) + frame(8, 1)
    parser = Parser()
    assert parser.feed(stream[:cut]) + parser.feed(stream[cut:]) == [Instruction(7, 3, data), Instruction(8, 1, b"")]
    broken = bytearray(frame(7, 3, data))
    broken[-1] ^= 1
    assert Parser().feed(bytes(broken)) == []


@given(value=st.integers(-32_767, 32_767))
def test_signs_are_the_sdks(value: int) -> None:
    sdk = protocol_packet_handler(Wire(), 0)
    assert magnitude(value) == sdk.scs_toscs(value, 15) and number(magnitude(value)) == value
    data = registers.GOAL_POSITION.encode(value)
    assert data == bytes([sdk.scs_lobyte(magnitude(value)), sdk.scs_hibyte(magnitude(value))])
    assert registers.GOAL_POSITION.decode(data) == value
    if abs(value) < 1024:
        assert registers.PRESENT_LOAD.decode(sdk.scs_toscs(value, 10).to_bytes(2, "little")) == value


def test_addresses_are_the_sdks() -> None:
    assert registers.GOAL_POSITION.address == SMS_STS_GOAL_POSITION_L
    assert registers.LOCK.address == SMS_STS_LOCK
    assert registers.PRESENT_CURRENT.address == SMS_STS_PRESENT_CURRENT_L


def test_motion_is_straight_and_then_of_first_order() -> None:
    motor = Motor(1, 0, 0.0)
    for address, data in ((46, (500).to_bytes(2, "little")), (42, (1000).to_bytes(2, "little")), (40, b"\x01")):
        motor.write(address, data, 0.0)
    top = 500 * 0.0146 / 60 * 4096
    motor.advance(1.0)
    assert motor.position == pytest.approx(top)
    corner = (1000 - top / GAIN) / top
    motor.advance(corner + 0.05)
    assert motor.position == pytest.approx(1000 - top / GAIN * exp(-GAIN * 0.05))


def test_the_lock_keeps_what_is_written_from_a_restart() -> None:
    motor = Motor(1, 3 * 4096 + 5, 0.0)
    motor.write(21, b"\x09", 0.0)
    assert motor.memory[21] == 9
    motor.restart(1.0)
    assert motor.memory[21] == 32 and motor.position == 5
    motor.write(55, b"\x00", 1.0)
    motor.write(21, b"\x09", 1.0)
    motor.restart(2.0)
    assert motor.memory[21] == 9 and motor.memory[55] == 1
