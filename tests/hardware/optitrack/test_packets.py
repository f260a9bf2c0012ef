"""The parser against an encoder of our own, for every version; what is cut, damaged or unknown; and the fuzz."""

from __future__ import annotations

import random
import struct
import time

import numpy as np
import pytest

from apcc_torch.errors import CommunicationError, HardwareError
from apcc_torch.hardware.optitrack import packets
from hardware.emulators import natnet_layout as layout
from hardware.emulators.natnet_layout import Body, Version
from hardware.emulators.natnet_server import standing
from hardware.optitrack.streams import NAMES, TICK_RATE, Stream

every_version = pytest.mark.parametrize("version", layout.VERSIONS)


def bodies(tracked: bool = True) -> list[Body]:
    return [Body(number, row[:3], row[3:], tracked) for number, row in zip(NAMES, standing(4), strict=True)]


def framed(version: Version, sequence: int = 7, extras: bool = True) -> bytes:
    return layout.frame(version, sequence, bodies(), 12.5, 124_960_000, 125_000_000, extras)


def parse(data: bytes, version: Version) -> packets.Frame:
    message, buffer = packets.open_datagram(data)
    assert message == packets.FRAME
    return packets.read_frame(buffer, version)


@every_version
@pytest.mark.parametrize("extras", [True, False])
def test_a_frame_comes_through(version: Version, extras: bool) -> None:
    frame = parse(framed(version, 7, extras), version)
    assert (frame.sequence, frame.timestamp) == (7, 12.5)
    assert list(frame.bodies) == list(NAMES)
    for row, body in zip(standing(4), frame.bodies.values(), strict=True):
        np.testing.assert_allclose((*body.position, *body.quaternion), row, atol=1e-7)
        assert body.tracked
    assert frame.times(TICK_RATE) == (pytest.approx(12.496), pytest.approx(12.5), True)
    assert frame.times(0) == (12.5, 12.5, False)


@every_version
def test_untracked_bodies_stay_in_the_frame(version: Version) -> None:
    frame = parse(layout.frame(version, 1, bodies(tracked=False), 0.0), version)
    assert [body.tracked for body in frame.bodies.values()] == [False] * 4
    assert frame.times(TICK_RATE) == (0.0, 0.0, False)  # no high-resolution stamps: the software stamp


@every_version
@pytest.mark.parametrize("extras", [True, False])
def test_names_come_through(version: Version, extras: bool) -> None:
    message, buffer = packets.open_datagram(layout.model(version, NAMES, extras))
    assert message == packets.MODEL
    assert packets.read_body_ids(buffer, version) == {name: number for number, name in NAMES.items()}


def test_two_bodies_of_one_name_or_number_are_refused() -> None:
    buffer = packets.open_datagram(layout.model((4, 1), {1: "base", 2: "base"}))[1]
    with pytest.raises(CommunicationError, match="two rigid bodies of one name"):
        packets.read_body_ids(buffer, (4, 1))
    twice = [*bodies(), bodies()[0]]
    with pytest.raises(CommunicationError, match="two rigid bodies of one id"):
        parse(layout.frame((4, 1), 1, twice, 0.0), (4, 1))


@every_version
def test_known_versions_are_accepted(version: Version) -> None:
    message, buffer = packets.open_datagram(layout.server_info(version))
    server = packets.read_server(buffer)
    assert (message, server) == (packets.SERVER_INFO, packets.Server("Motive", version, TICK_RATE))
    packets.check_version(server)


@pytest.mark.parametrize("version", [(2, 10), (3, 2), (4, 3), (5, 0), (0, 0)])
def test_unknown_versions_are_refused(version: Version) -> None:
    server = packets.read_server(packets.open_datagram(layout.server_info(version))[1])
    with pytest.raises(HardwareError, match=rf"'Motive' streams NatNet {version[0]}\.{version[1]}; known are 3\.0, "):
        packets.check_version(server)


def test_an_old_server_tells_no_tick_rate() -> None:
    data = layout.server_info((3, 0))[: 4 + 264]
    data = layout.message(packets.SERVER_INFO, data[4:])
    assert packets.read_server(packets.open_datagram(data)[1]).tick_rate == 0


def test_requests_are_what_the_protocol_says() -> None:
    assert packets.request(packets.CONNECT) == b"\x00\x00\x05\x00Ping\x00"
    assert packets.request(packets.REQUEST_MODEL) == b"\x04\x00\x01\x00\x00"
    assert packets.request(packets.KEEPALIVE) == b"\x0a\x00\x01\x00\x00"


@every_version
def test_a_datagram_cut_anywhere_is_an_error(version: Version) -> None:
    data = framed(version)
    for size in range(len(data)):
        with pytest.raises(CommunicationError, match=r"has no header|was cut"):
            packets.open_datagram(data[:size])
        if size >= 4:  # with a header that fits, the content itself is too short; the end mark is not missed
            lying = layout.message(packets.FRAME, data[4:size])
            if size < len(data) - (4 if version < (4, 1) else 12):
                with pytest.raises(CommunicationError, match="a frame cannot be read"):
                    parse(lying, version)


def test_a_stamp_that_is_no_number_is_an_error() -> None:
    with pytest.raises(CommunicationError, match="stamped nan"):
        parse(layout.frame((4, 1), 1, bodies(), float("nan")), (4, 1))


@every_version
@pytest.mark.parametrize("reader", ["frame", "model"])
def test_a_damaged_count_costs_neither_time_nor_memory(version: Version, reader: str) -> None:
    data = framed(version) if reader == "frame" else layout.model(version, NAMES)
    read = packets.read_frame if reader == "frame" else packets.read_body_ids
    began, refused = time.perf_counter(), []
    for place in range(4, len(data) - 4):
        for count in (0xFFFFFFFF, 0x7FFFFFFF):
            damaged = data[:place] + struct.pack("<I", count) + data[place + 4 :]
            try:
                read(packets.open_datagram(damaged)[1], version)
            except CommunicationError as error:
                refused.append(str(error))
    assert any("cannot be read" in sentence for sentence in refused)
    assert time.perf_counter() - began < 30.0


def mutated(data: bytes, rng: random.Random) -> bytes:
    """The datagram with some damage; half of them keep a header that fits, so that the content is read."""
    content = bytearray(data)
    for _ in range(rng.randint(1, 4)):
        place, kind = rng.randrange(len(content)), rng.randrange(6)
        if kind == 0:
            content[place] ^= 1 << rng.randrange(8)
        elif kind == 1:
            content[place] = rng.randrange(256)
        elif kind == 2:
            extreme = rng.choice([0, 1, 0x7FFFFFFF, 0x80000000, 0xFFFFFFFF, 0x7FC00000, 0x7F800000])
            content[place : place + 4] = struct.pack("<I", extreme)
        elif kind == 3:
            del content[place : place + rng.randint(1, 40)]
        elif kind == 4:
            content[place:place] = rng.randbytes(rng.randint(1, 40))
        else:
            other = rng.randrange(len(content))
            content[place : place + 16] = content[other : other + 16]
        if not content:
            content = bytearray(b"\0")
    if rng.random() < 0.5 and len(content) >= 4:
        content[:4] = data[:2] + struct.pack("<H", len(content) - 4)
    return bytes(content)


def test_a_hundred_thousand_mutated_packets_raise_nothing_but_the_one_error() -> None:
    rng = random.Random(20)
    stream = Stream()
    stream.run(10)
    refused, taken, names = 0, 0, 0
    other = {v: (layout.model(v, NAMES), layout.server_info(v), framed(v)) for v in layout.VERSIONS}
    small = {v: [framed(v, i, extras=False) for i in range(20)] for v in layout.VERSIONS}
    for i in range(100_000):
        version = layout.VERSIONS[i % 5]
        # Mostly frames of rigid bodies alone, as they should be streamed; some with all else, and the other packets.
        good = other[version][i // 5 % 3] if i % 50 < 5 else small[version][i // 50 % 20]
        data = mutated(good, rng)
        try:
            message, buffer = packets.open_datagram(data)
            if message == packets.FRAME:
                frame = packets.read_frame(buffer, version)
                stream.now += 0.01
                sample = stream.tracker.update(frame, TICK_RATE, stream.now)
                taken += 1
                if sample is not None:  # whatever is called valid is finite and a rotation
                    R = sample.T[sample.valid, :3, :3]
                    assert np.isnan(sample.T[~sample.valid]).all()
                    assert not R.size or np.abs(R @ R.transpose(0, 2, 1) - np.eye(3)).max() < 1e-9
            elif message == packets.MODEL:
                packets.read_body_ids(buffer, version)
                names += 1
            elif message == packets.SERVER_INFO:
                packets.read_server(buffer)
        except CommunicationError:
            refused += 1
    assert refused > 30_000 and taken > 10_000 and names > 0
