"""The parser against an encoder of our own, for every version; what is cut, damaged or unknown; and the fuzz."""

from __future__ import annotations

import random
import struct
import time

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from apcc_torch.errors import CommunicationError, HardwareError
from apcc_torch.hardware.optitrack import packets
from hardware.emulators import natnet_layout as layout
from hardware.emulators.mocap_server import Body, standing
from hardware.emulators.natnet_layout import Version
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
    assert packets.read_body_ids(buffer, version) == [(name, number) for number, name in NAMES.items()]


@every_version
def test_two_bodies_of_one_number_are_neither_of_them_seen(version: Version) -> None:
    twice = [*bodies(), bodies()[0]]
    assert list(parse(layout.frame(version, 1, twice, 0.0), version).bodies) == [2, 3, 4]


@pytest.mark.parametrize("version", [(3, 0), (4, 0)])
def test_what_has_no_size_and_is_not_known_ends_the_reading_only_where_a_name_is_missing(version: Version) -> None:
    data = layout.model(version, NAMES, extras=False)
    more = struct.pack("<I", 5) + data[8:] + struct.pack("<I", 9) + b"of a kind that is not known"
    data = layout.message(packets.MODEL, more)
    found = packets.read_body_ids(packets.open_datagram(data)[1], version, list(NAMES.values()))
    assert dict(found) == {name: number for number, name in NAMES.items()}
    with pytest.raises(CommunicationError, match="no definition of kind 9 is known"):
        packets.read_body_ids(packets.open_datagram(data)[1], version, ["disk_9"])


def test_a_name_that_is_no_text_is_no_reason() -> None:
    """Motive gives names in the code page of its computer."""
    names = {**NAMES, 9: "Stativ für Kameras".encode("latin-1").decode(errors="surrogateescape")}
    for version in layout.VERSIONS:
        found = packets.read_body_ids(packets.open_datagram(layout.model(version, names))[1], version)
        assert found[:4] == [(name, number) for number, name in NAMES.items()] and found[4][1] == 9
    info = layout.server_info((4, 1), name="Motive \udcfc" + 300 * "x")  # and fills its place, without an end
    server = packets.read_server(packets.open_datagram(info)[1])
    assert server.version == (4, 1) and server.tick_rate == TICK_RATE and server.name.startswith("Motive \ufffd")


NUMBERS = st.integers(1, 2**31 - 1)
TEXTS = st.binary(max_size=12).map(lambda data: data.replace(b"\0", b"?").decode(errors="surrogateescape"))
POSES = st.lists(st.floats(-100, 100, width=32), min_size=7, max_size=7)


@st.composite
def streams(draw: st.DrawFn) -> tuple[Version, list[Body], bytes, bytes]:
    """A version; bodies of ours, some of them; and a frame and definitions that hold them among whatever else there is.

    Other bodies come in between, some of one id; sections hold much or nothing; definitions come in any order.
    """
    version = draw(st.sampled_from(layout.VERSIONS))
    seen = draw(st.permutations(list(NAMES)))[: draw(st.integers(0, 4))]
    ours = [Body(number, *_split(draw(POSES)), draw(st.booleans())) for number in seen]
    others = draw(st.lists(st.integers(5, 9), max_size=6))
    mixed = draw(st.permutations([*ours, *(Body(number, (0, 0, 1), (0, 0, 0, 1)) for number in others)]))
    texts, many = (
        draw(st.lists(TEXTS, min_size=4, max_size=4)),
        draw(st.lists(st.integers(0, 3), min_size=7, max_size=7)),
    )
    sized = version >= (4, 1)
    marker = struct.pack("<3f", 1, 2, 3)
    items = [
        [layout.text(texts[0]) + struct.pack("<I", many[0]) + many[0] * marker] * many[1],
        [marker] * many[2],
        [layout.rigid_body(body) for body in mixed],
        [struct.pack("<iI", 7, many[3]) + many[3] * layout.rigid_body(Body(1, (0, 0, 1), (0, 0, 0, 1)))] * many[4],
        *([[draw(st.binary(max_size=60))] * many[5]] if sized else []),  # assets: skipped, whatever they hold
        [struct.pack("<i4fhf", 3, 0, 0, 0, 0, 0, 0)] * many[6],
        [layout.channels(number) for number in range(many[0])],
        [layout.channels(number) for number in range(many[1])],
    ]
    payload = struct.pack("<I", 7) + b"".join(layout.section(version, section) for section in items)
    payload += struct.pack("<IId3Q", 0, 0, 1.0, 0, 0, 0) + sized * b"precise!" + struct.pack("<hI", 0, 0)
    named = [(1, layout.body_description(version, number, name)) for number, name in NAMES.items()]
    named += [(1, layout.body_description(version, number, "x" + text)) for number, text in enumerate(texts, 5)]
    named += [(0, layout.text(texts[0]) + struct.pack("<I", 1) + layout.text(texts[1]))] * many[2]
    named += [(5, layout.text(texts[2]) + struct.pack("<7f", *range(7)))] * many[3]
    unknown = st.tuples(st.integers(2, 1000), st.binary(max_size=40))
    named += draw(st.lists(unknown, max_size=3)) if sized else []
    named = draw(st.permutations(named))
    model = struct.pack("<I", len(named))
    for kind, content in named:
        model += struct.pack("<I", kind) + (struct.pack("<I", len(content)) if sized else b"") + content
    return version, ours, layout.message(packets.FRAME, payload), layout.message(packets.MODEL, model)


def _split(pose: list[float]) -> tuple[list[float], list[float]]:
    return pose[:3], pose[3:]


@settings(max_examples=150)
@given(stream=streams())
def test_our_bodies_are_found_among_whatever_else_is_streamed(
    stream: tuple[Version, list[Body], bytes, bytes],
) -> None:
    version, ours, frame, model = stream
    found = parse(frame, version).bodies
    for body in ours:
        assert (*found[body.number].position, *found[body.number].quaternion) == (*body.position, *body.quaternion)
        assert found[body.number].tracked == body.tracked
    assert not {number for number in NAMES if number in found} - {body.number for body in ours}
    named = dict(packets.read_body_ids(packets.open_datagram(model)[1], version, list(NAMES.values())))
    assert {name: named[name] for name in NAMES.values()} == {name: number for number, name in NAMES.items()}


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


def test_a_stamp_that_is_no_number_is_an_error_where_there_is_no_other() -> None:
    frame = parse(layout.frame((4, 1), 1, bodies(), float("nan"), 124_960_000, 125_000_000), (4, 1))
    assert frame.times(TICK_RATE) == (pytest.approx(12.496), pytest.approx(12.5), True)
    with pytest.raises(CommunicationError, match="stamped nan"):
        frame.times(0)
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
