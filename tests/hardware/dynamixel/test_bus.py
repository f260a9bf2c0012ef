"""Packets: stuffing both ways, refusals, and a line that was left in use."""

from __future__ import annotations

from collections.abc import Iterator

import pytest
from hypothesis import given
from hypothesis import strategies as st

from apcc_torch.errors import CommunicationError, DeviceFaultError
from apcc_torch.hardware.dynamixel.bus import DynamixelBus
from apcc_torch.hardware.dynamixel.registers import (
    BUS_WATCHDOG,
    GOAL_POSITION,
    OPERATING_MODE,
    PRESENT_POSITION,
    TORQUE_ENABLE,
)
from apcc_torch.hardware.servos.bus import raise_all
from apcc_torch.hardware.servos.port import BusPort
from hardware.dynamixel.rig import POSITIONS, TENDONS
from hardware.emulators.servo.emulator import ServoEmulator
from hardware.emulators.servo.packet import frame, status

STUFFED = -131_073  # FF FF FD FF: the header's bytes in the data
MOTOR = TENDONS[0]


@pytest.fixture
def bus(emulator: ServoEmulator) -> Iterator[DynamixelBus]:
    opened = DynamixelBus(BusPort(str(emulator.link), 1_000_000, 0.25), {MOTOR: "motor 1"})
    opened.open()
    yield opened
    opened.close()


def test_the_header_in_the_data_gets_through_both_ways(bus: DynamixelBus, emulator: ServoEmulator) -> None:
    bus.sync_write(GOAL_POSITION, dict.fromkeys(TENDONS, STUFFED))
    assert bus.read(MOTOR, GOAL_POSITION) == STUFFED
    assert {emulator.report()[motor]["goal"] for motor in TENDONS} == {STUFFED}
    bus.write(MOTOR, GOAL_POSITION, STUFFED)
    assert emulator.report()[MOTOR]["bad_packets"] == 0
    emulator.do("turn", MOTOR, position=STUFFED)
    found = bus.sync_read(TENDONS, PRESENT_POSITION.address, 4)
    assert PRESENT_POSITION.decode(found[MOTOR]) == STUFFED
    assert PRESENT_POSITION.decode(found[TENDONS[1]]) == POSITIONS[TENDONS[1]]


def test_refusals_name_the_motor_and_the_register(bus: DynamixelBus) -> None:
    with pytest.raises(DeviceFaultError, match=r"bus watchdog = -1: motor 1 \(id 11\) says the value is out of range"):
        bus.write(MOTOR, BUS_WATCHDOG, -1)
    with pytest.raises(DeviceFaultError, match="out of range"):
        bus.write(MOTOR, GOAL_POSITION, 1_048_576)
    bus.write(MOTOR, TORQUE_ENABLE, 1)
    with pytest.raises(DeviceFaultError, match=r"operating mode = 3: .* cannot be read or written now"):
        bus.write(MOTOR, OPERATING_MODE, 3)
    with pytest.raises(DeviceFaultError, match=r"motor 1 \(id 11\) says the address cannot be read"):
        bus.read_bytes(MOTOR, 690, 20)


def test_an_interrupted_exchange_does_not_block_the_line(bus: DynamixelBus) -> None:
    bus.port.is_using = True  # as Ctrl-C in the SDK leaves it
    bus.ping(MOTOR)
    bus.port.is_using = True
    assert bus.read(MOTOR, PRESENT_POSITION) == POSITIONS[MOTOR]
    bus.port.is_using = True
    bus.sync_write(GOAL_POSITION, {MOTOR: 5})
    assert bus.read(MOTOR, GOAL_POSITION) == 5


def test_a_motor_that_is_not_there(bus: DynamixelBus) -> None:
    for ask in (lambda: bus.ping(99), lambda: bus.read(99, GOAL_POSITION), lambda: bus.write(99, TORQUE_ENABLE, 0)):
        with pytest.raises(CommunicationError, match=r"motor \(id 99\): no reply"):
            ask()


def test_a_gathering_keeps_what_it_got(bus: DynamixelBus, emulator: ServoEmulator) -> None:
    emulator.do("mute", TENDONS[2])
    emulator.do("short", TENDONS[4], amount=1)
    found, wrong = bus.sync_gather(TENDONS, PRESENT_POSITION.address, 4)
    assert set(wrong) == {TENDONS[2], TENDONS[4]} and set(found) == set(TENDONS) - set(wrong)
    assert all(PRESENT_POSITION.decode(data) == POSITIONS[motor] for motor, data in found.items())


def test_a_lost_reply_weighs_more_than_a_fault() -> None:
    raise_all([])
    with pytest.raises(DeviceFaultError, match=r"^a; b$"):
        raise_all([DeviceFaultError("a"), DeviceFaultError("b")])
    with pytest.raises(CommunicationError, match=r"^a; b$"):
        raise_all([DeviceFaultError("a"), CommunicationError("b")])


class MemoryPort:
    """A port without a line: what is to come lies there, once something has been written."""

    is_open, is_using = True, False

    def __init__(self, replies: bytes) -> None:
        self.replies, self.here = replies, b""

    def clearPort(self) -> None:
        self.here = b""

    def writePort(self, packet: list[int]) -> int:
        self.here += self.replies
        return len(packet)

    def readPort(self, length: int) -> bytes:
        taken, self.here = self.here[:length], self.here[length:]
        return taken

    def setPacketTimeout(self, length: int) -> None:
        pass

    def isPacketTimeout(self) -> bool:
        return not self.here


LENGTH = 6
GOOD, REFUSED, LONG, CORRUPT, CUT, NOISE = "good", "refused", "long", "corrupt", "cut", "noise"
REPLY = st.tuples(
    st.sampled_from([GOOD, GOOD, GOOD, REFUSED, LONG, CORRUPT, CUT, NOISE]),
    st.sampled_from([*TENDONS, 1, 200]),
    st.binary(min_size=LENGTH, max_size=LENGTH),
    st.integers(1, 12),
)


def spoken(kind: str, motor: int, data: bytes, amount: int) -> bytes:
    """One reply as it comes over the line."""
    if kind == REFUSED:
        return status(motor, 1 + amount % 7, b"")
    if kind == LONG:
        return frame(motor, bytes([0x55, 0]) + data + data[:amount])
    if kind == NOISE:
        return data[:amount]
    whole = status(motor, 0, data)
    if kind == CORRUPT:
        return whole[:-3] + bytes([whole[-3] ^ 0x10]) + whole[-2:]
    return whole[: len(whole) - amount] if kind == CUT else whole


@given(asked=st.permutations(TENDONS), count=st.integers(1, 9), replies=st.lists(REPLY, max_size=14))
def test_whatever_comes_back_only_whole_replies_are_believed(
    asked: list[int], count: int, replies: list[tuple[str, int, bytes, int]]
) -> None:
    """Any subset of motors, in any order, some twice, some that were not asked, some spoilt."""
    motors = asked[:count]
    bus = DynamixelBus(MemoryPort(b"".join(spoken(*reply) for reply in replies)), {})  # type: ignore[arg-type]
    answers, wrong = bus.sync_gather(motors, PRESENT_POSITION.address, LENGTH)
    assert set(answers) | set(wrong) == set(motors) and not set(answers) & set(wrong)
    assert all(isinstance(error, CommunicationError | DeviceFaultError) for error in wrong.values())
    for motor, data in answers.items():
        assert data in [told for kind, one, told, _ in replies if kind == GOOD and one == motor]
    if all(kind in (GOOD, REFUSED, LONG) for kind, *_ in replies):  # nothing swallows what follows it
        for motor in motors:
            first = next((kind for kind, one, *_ in replies if one == motor), None)
            assert (motor in answers) == (first == GOOD)
