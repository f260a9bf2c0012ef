"""NatNet datagrams as Motive sends them, versions 3.0 to 4.2: an encoder written from the protocol, for tests."""

from __future__ import annotations

import struct
from collections.abc import Mapping, Sequence

from hardware.emulators.mocap_server import Body

Version = tuple[int, int]

CONNECT, SERVER_INFO, REQUEST_MODEL, MODEL, FRAME, KEEPALIVE, UNRECOGNIZED = 0, 1, 4, 5, 7, 10, 100
TICK_RATE = 10_000_000
VERSIONS: tuple[Version, ...] = ((3, 0), (3, 1), (4, 0), (4, 1), (4, 2))


def message(number: int, payload: bytes) -> bytes:
    return struct.pack("<HH", number, len(payload)) + payload


def text(value: str) -> bytes:
    """A text; bytes that are no UTF-8 stand in it as Python escapes them."""
    return value.encode(errors="surrogateescape") + b"\0"


def server_info(version: Version, tick_rate: int = TICK_RATE, name: str = "Motive", data_port: int = 1511) -> bytes:
    payload = text(name)[:256].ljust(256, b"\0") + bytes((3, 1, 0, 0)) + bytes((*version, 0, 0))
    payload += struct.pack("<QHB4B", tick_rate, data_port, 0, 239, 255, 42, 99)
    return message(SERVER_INFO, payload)


def section(version: Version, items: Sequence[bytes]) -> bytes:
    """A counted list, which from 4.1 on also tells its size."""
    content = b"".join(items)
    size = struct.pack("<I", len(content)) if version >= (4, 1) else b""
    return struct.pack("<I", len(items)) + size + content


def rigid_body(body: Body) -> bytes:
    numbers = struct.pack("<i7f", body.number, *body.position, *body.quaternion)
    return numbers + struct.pack("<fh", 2e-4, int(body.tracked))


def channels(number: int) -> bytes:
    """A force plate or another device with two channels."""
    return struct.pack("<iiifffif", number, 2, 3, 1.0, 2.0, 3.0, 1, 4.0)


def frame(
    version: Version,
    sequence: int,
    bodies: Sequence[Body],
    timestamp: float,
    mid_exposure: int = 0,
    transmit: int = 0,
    extras: bool = True,
) -> bytes:
    """A frame; with `extras`, every other list holds something too."""
    marker = struct.pack("<3f", 0.1, 0.2, 0.3)
    labelled = struct.pack("<i4fhf", (1 << 16) + 2, 0.1, 0.2, 0.3, 0.01, 10, 1e-4)
    markers = text("all \udcfc") + struct.pack("<I", 2) + 2 * marker
    skeleton = struct.pack("<iI", 7, 1) + rigid_body(Body((7 << 16) + 1, (0, 0, 1), (0, 0, 0, 1)))
    asset_marker = struct.pack("<i4fhf", 3, 0.1, 0.2, 0.3, 0.01, 0, 1e-4)
    asset = struct.pack("<iI", 9, 1) + rigid_body(Body(1, (0, 0, 1), (0, 0, 0, 1)))
    asset += struct.pack("<I", 1) + asset_marker
    many = 1 if extras else 0
    payload = struct.pack("<I", sequence & 0xFFFFFFFF)
    payload += section(version, many * [markers])
    payload += section(version, many * [marker, marker])
    payload += section(version, [rigid_body(body) for body in bodies])
    payload += section(version, many * [skeleton])
    if version >= (4, 1):
        payload += section(version, many * [asset])
    payload += section(version, many * [labelled])
    payload += section(version, many * [channels(1)])
    payload += section(version, many * [channels(2)])
    payload += struct.pack("<IId3Q", 0, 0, timestamp, mid_exposure, max(transmit - 1000, 0), transmit)
    if version >= (4, 1):
        payload += struct.pack("<II", 12, 34)  # the precision stamp that the parser does not know
    payload += struct.pack("<hI", 0, 0)  # parameters, and the end mark
    return message(FRAME, payload)


def body_description(version: Version, number: int, name: str) -> bytes:
    data = text(name) + struct.pack("<ii3f", number, -1, 0, 0, 0)
    if version >= (4, 2):
        data += struct.pack("<4f", 0, 0, 0, 1)
    data += struct.pack("<I6f2i", 2, 0, 0, 0, 0.1, 0, 0, 0, 0)
    if version >= (4, 0):
        data += text("Marker1") + text("Marker2")
    return data


def model(version: Version, names: Mapping[int, str], extras: bool = True) -> bytes:
    """Model definitions: rigid bodies' names by number."""
    found = [(0, text(name) + struct.pack("<I", 1) + text("Marker1")) for name in names.values() if extras]
    found += [(1, body_description(version, number, name)) for number, name in names.items()]
    if extras:
        skeleton = text("Person") + struct.pack("<iI", 7, 1) + body_description(version, 1, "Hip")
        device = struct.pack("<i", 2) + text("Amplifier") + text("0001") + struct.pack("<iiI", 2, 0, 1) + text("ch1")
        camera = text("Camera \udcfc") + struct.pack("<7f", 0, 0, 2, 0, 0, 0, 1)
        plate = struct.pack("<i", 1) + text("0007") + struct.pack("<161f", *range(161))
        plate += struct.pack("<iiI", 0, 0, 2) + text("Fx") + text("Fy")
        found = [(5, camera), (3, plate), *found, (2, skeleton), (4, device)]
    if extras and version >= (4, 1):
        marker = text("m") + struct.pack("<i4fh", 3, 0, 0, 0, 0.01, 0)
        asset = text("Asset") + struct.pack("<iiI", 1, 9, 1) + body_description(version, 1, "Bone")
        found += [(6, asset + struct.pack("<I", 1) + marker), (9, b"of a kind that is not known")]
    payload = struct.pack("<I", len(found))
    for kind, content in found:
        size = struct.pack("<I", len(content)) if version >= (4, 1) else b""
        payload += struct.pack("<I", kind) + size + content
    return message(MODEL, payload)
