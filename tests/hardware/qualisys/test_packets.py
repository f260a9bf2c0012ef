"""Packets of QTM against an encoder of our own: what is read, and what damage is told as."""

from __future__ import annotations

import math
import random
import struct

import numpy as np
import pytest
import torch

from apcc_torch.errors import CommunicationError
from apcc_torch.hardware.qualisys import packets
from apcc_torch.lie.rotations import quaternion_rotation
from hardware.emulators import qtm_server as qtm
from hardware.emulators.mocap_server import Body


def bodies(count: int = 4, seed: int = 0) -> list[Body | None]:
    draw = np.random.default_rng(seed)
    turns = draw.normal(size=(count, 4))
    turns /= np.linalg.norm(turns, axis=1, keepdims=True)
    return [Body(k + 1, draw.uniform(-1, 1, 3), turns[k]) for k in range(count)]


def data_of(packet: bytes) -> bytes:
    kind, body = packets.open_datagram(packet)
    assert kind == packets.DATA
    return body


@pytest.mark.parametrize("extras", [False, True])
def test_a_frame_says_what_was_written(extras: bool) -> None:
    told = bodies()
    found = packets.read_frame(data_of(qtm.frame(77, told, 12_345_678, extras)), len(told))
    assert found is not None and found.sequence == 77
    assert found.times(packets.MICROSECONDS) == (12.345678, 12.345678, False)
    for k, body in enumerate(told):
        assert body is not None and found.bodies[k].tracked
        np.testing.assert_allclose(found.bodies[k].position, 1e3 * body.position, atol=1e-4)  # mm
        have, want = (
            quaternion_rotation(torch.tensor(np.array(q))) for q in (found.bodies[k].quaternion, body.quaternion)
        )
        torch.testing.assert_close(have, want, rtol=0, atol=1e-6)


def test_untracked_is_nan_and_what_is_no_rotation_has_no_quaternion() -> None:
    one, two, three, four = bodies()
    assert one is not None and two is not None and three is not None and four is not None
    two.tracked, three.quaternion, four.position = False, 1.05 * three.quaternion, np.full(3, np.nan)
    found = packets.read_frame(data_of(qtm.frame(1, [None, two, three, four], 0, False)), 4)
    assert found is not None
    assert [found.bodies[k].tracked for k in range(4)] == [False, False, True, True]
    assert found.bodies[2].quaternion == (0.0, 0.0, 0.0, 0.0)
    assert all(map(math.isnan, found.bodies[3].position)) and math.hypot(*found.bodies[3].quaternion) == pytest.approx(
        1
    )


def test_a_frame_without_bodies_is_none_and_another_number_of_them_is_refused() -> None:
    empty = struct.pack("<qII", 0, 1, 0)
    assert packets.read_frame(empty, 4) is None
    with pytest.raises(CommunicationError, match="4 bodies, and the parameters name 3"):
        packets.read_frame(data_of(qtm.frame(1, bodies(), 0, True)), 3)


def test_damage_of_any_kind_is_told_at_once() -> None:
    good = data_of(qtm.frame(9, bodies(), 5, True))
    draw = random.Random(3)
    refused = 0
    for _ in range(600):
        bad = bytearray(good)
        if draw.random() < 0.5:
            del bad[draw.randrange(len(bad)) :]
        for _ in range(draw.randrange(1, 4)):
            if bad:
                bad[draw.randrange(len(bad))] = draw.randrange(256)
        try:
            packets.read_frame(bytes(bad), 4)
        except CommunicationError:
            refused += 1
    assert refused > 200
    # A component of no size, of which there are billions, would keep the parser busy for hours.
    endless = struct.pack("<qII", 0, 1, 0xFFFFFFFF) + struct.pack("<II", 0, 5) * 4
    with pytest.raises(CommunicationError, match="0 bytes"):
        packets.read_frame(endless, 4)


def test_a_stream_comes_apart_into_its_packets_however_it_is_cut() -> None:
    sent = [qtm.text(packets.COMMAND, "Version set to 1.25"), qtm.frame(1, bodies(), 0, False), qtm.packet(6, b"\x0b")]
    stream, draw = b"".join(sent), random.Random(1)
    found, rest = [], b""
    while stream:
        cut = draw.randrange(1, 40)
        whole, rest = packets.split(rest + stream[:cut])
        found, stream = found + whole, stream[cut:]
    assert rest == b"" and [kind for kind, _ in found] == [packets.COMMAND, packets.DATA, packets.EVENT]
    assert packets.text_of(found[0][1]) == "Version set to 1.25"
    with pytest.raises(CommunicationError, match="a packet says that it has"):
        packets.split(b"\xff" * 16)


def test_a_datagram_that_is_cut_is_refused() -> None:
    whole = qtm.frame(1, bodies(), 0, False)
    for cut in (0, 5, 8, 60):
        with pytest.raises(CommunicationError, match="a datagram has"):
            packets.open_datagram(whole[:cut])


def test_names_come_in_the_order_of_the_parameters() -> None:
    named = packets.read_bodies(qtm.parameters(["base", " a&b ", "disk_1"], "1.25").encode() + b"\0")
    assert named == [("base", 0), ("a&b", 1), ("disk_1", 2)]
    assert packets.read_bodies(b"<QTM_Parameters_Ver_1.25><The_6D/></QTM_Parameters_Ver_1.25>\0") == []
    with pytest.raises(CommunicationError, match="parameters cannot be read"):
        packets.read_bodies(b"<QTM_Par")
