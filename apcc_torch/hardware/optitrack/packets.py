"""NatNet datagrams: requests to the server, and its answers and frames read with the `natnet` package's parser.

Known are the bit stream versions 3.0 to 4.2. The parser trusts every count that a datagram holds, so its buffer is
bounded here: a damaged count ends in an error at once, not in gigabytes or minutes. It misreads the end of a frame from
4.1 on (the frame's parameters); only what stands before that is used. What is not needed does not decide: it is skipped
where it tells its size, and texts may hold what is no UTF-8.
"""

from __future__ import annotations

import math
import struct
from collections import Counter
from collections.abc import Collection
from dataclasses import dataclass
from typing import Any

from apcc_torch.errors import CommunicationError, HardwareError
from apcc_torch.hardware.mocap.bodies import BodyPose

try:
    from natnet.data_descriptions import (
        CameraDescription,
        DeviceDescription,
        MarkerSetDescription,
        RigidBodyDescription,
        SkeletonDescription,
    )
    from natnet.data_frame import Device, ForcePlate, FrameSuffix, LabeledMarker, MarkerSet, RigidBody, Skeleton
    from natnet.exceptions import NatNetError
    from natnet.packet_buffer import PacketBuffer
    from natnet.version import Version
except ModuleNotFoundError:  # the settings can be read all the same; who builds the sensor is told
    NatNetError, PacketBuffer = ValueError, object

CONNECT = 0
SERVER_INFO = 1
REQUEST_MODEL = 4
MODEL = 5
FRAME = 7
KEEPALIVE = 10

KNOWN_VERSIONS = ((3, 0), (3, 1), (4, 0), (4, 1), (4, 2))

_HEADER = struct.Struct("<HH")  # message, bytes that follow
_TICK_RATE = struct.Struct("<Q")
_NAME = 256  # bytes of the server's name
_SIZED = (4, 1)  # the first version that tells the size of each section and definition
_BODY, _PLATE = 1, 3  # kinds of definitions

# What the parser raises over a damaged datagram.
_DAMAGED = (struct.error, ValueError, IndexError, OverflowError, NatNetError)


# A frame's sections, in order.
_SECTIONS = (
    *("marker sets", "unlabelled markers", "rigid bodies", "skeletons", "assets"),
    *("labelled markers", "force plates", "devices"),
)


@dataclass(frozen=True)
class Server:
    """What the server says of itself.

    Attributes:
        name: The program's name.
        version: Bit stream version, (major, minor).
        tick_rate: Ticks per second of its high-resolution stamps; 0 where it does not tell.
    """

    name: str
    version: tuple[int, int]
    tick_rate: int


@dataclass(frozen=True)
class Frame:
    """One frame of motion capture.

    Attributes:
        sequence: Frame number.
        bodies: Rigid bodies by their streaming id.
        timestamp: The server's software stamp of the frame, s.
        mid_exposure: Middle of the cameras' exposure, ticks; 0 where it is not known.
        transmit: When the frame was sent, ticks; 0 where it is not known.
    """

    sequence: int
    bodies: dict[int, BodyPose]
    timestamp: float
    mid_exposure: int
    transmit: int

    def times(self, tick_rate: int) -> tuple[float, float, bool]:
        """When the frame was measured and sent, s of the server's clock, and whether by the high-resolution stamps.

        Those are two readings of one clock, so the server's own delay is known. Without them the software stamp serves
        for both.

        Raises:
            CommunicationError: That one is needed, and is no number.
        """
        if tick_rate > 0 and 0 < self.mid_exposure <= self.transmit:
            return self.mid_exposure / tick_rate, self.transmit / tick_rate, True
        if not math.isfinite(self.timestamp):
            raise CommunicationError(f"a frame is stamped {self.timestamp}")
        return self.timestamp, self.timestamp, False


class BoundedBuffer(PacketBuffer):
    """The parser's buffer, which never reads beyond its end."""

    pointer: int

    def read_string(self, max_length: int | None = None, static_length: bool = False) -> str:
        text, end, _ = bytes(self.data[self.pointer :]).partition(b"\0")
        if not end:
            raise ValueError("a text does not end within the datagram")
        self.pointer += len(text) + 1
        return text.decode(errors="replace")

    def skip_to(self, end: int) -> None:
        """Goes on there, if that lies within the datagram and not before what has been read."""
        if not self.pointer <= end <= len(self.data):
            raise ValueError("a section is longer or shorter than it says")
        self.pointer = end

    def read_float32_array(self, count: int) -> tuple[float, ...]:
        if count * 4 > len(self.data) - self.pointer:
            raise ValueError(f"{count} numbers do not fit into the datagram")
        return tuple(super().read_float32_array(count))

    def read(self, data_type: struct.Struct | str) -> tuple[Any, ...]:
        # Of a format in words, the struct module keeps the compiled form; natnet compiles it each time.
        form = data_type if isinstance(data_type, str) else data_type.format
        values = struct.unpack_from(form, self.data, self.pointer)
        self.pointer += struct.calcsize(form)
        return values

    def read_uint64(self) -> int:
        return int(self.read("<Q")[0])  # natnet's "L" has 4 bytes on some systems


def request(message: int) -> bytes:
    """A request to the server: `CONNECT`, `REQUEST_MODEL` or `KEEPALIVE`."""
    text = b"Ping\0" if message == CONNECT else b"\0"
    return _HEADER.pack(message, len(text)) + text


def open_datagram(data: bytes) -> tuple[int, BoundedBuffer]:
    """The message number and the buffer behind the header.

    Raises:
        CommunicationError: The datagram is shorter than it says.
    """
    if len(data) < _HEADER.size:
        raise CommunicationError(f"a datagram of {len(data)} bytes has no header")
    message, size = _HEADER.unpack_from(data)
    if len(data) - _HEADER.size < size:
        raise CommunicationError(f"a datagram was cut: {len(data) - _HEADER.size} of {size} bytes came")
    buffer = BoundedBuffer(data)
    buffer.pointer = _HEADER.size
    return message, buffer


def read_server(buffer: BoundedBuffer) -> Server:
    """Reads the server's answer to `CONNECT`.

    Raises:
        CommunicationError: It is damaged.
    """
    try:
        name = bytes(buffer.data[buffer.pointer : buffer.pointer + _NAME]).partition(b"\0")[0].decode(errors="replace")
        buffer.skip_to(buffer.pointer + _NAME)
        _, _, _, _, major, minor, _, _ = buffer.read("8B")
        rest = len(buffer.data) - buffer.pointer
        tick_rate = buffer.read(_TICK_RATE)[0] if rest >= _TICK_RATE.size else 0
    except _DAMAGED as error:
        raise CommunicationError(f"the server's answer cannot be read: {error}") from error
    return Server(name, (int(major), int(minor)), int(tick_rate))


def check_version(server: Server) -> None:
    """Refuses a bit stream that is not known.

    Raises:
        HardwareError: The version is none of `KNOWN_VERSIONS`.
    """
    if server.version not in KNOWN_VERSIONS:
        known = ", ".join(f"{major}.{minor}" for major, minor in KNOWN_VERSIONS)
        spoken = ".".join(map(str, server.version))
        raise HardwareError(f"the server {server.name!r} streams NatNet {spoken}; known are {known}")


def read_body_ids(
    buffer: BoundedBuffer, version: tuple[int, int], wanted: Collection[str] = ()
) -> list[tuple[str, int]]:
    """Reads the model definitions: rigid bodies' names and streaming ids.

    Definitions of all else are skipped, by their size where the version tells it. What follows the `wanted` names need
    not be readable.

    Raises:
        CommunicationError: They are damaged, or hold what is not known and has no size, and a name is not found.
    """
    found: list[tuple[str, int]] = []
    try:
        for _ in range(buffer.read_uint32()):
            kind = buffer.read_uint32()
            end = buffer.read_uint32() + buffer.pointer if version >= _SIZED else None
            if kind == _BODY and end is not None:
                found.append((buffer.read_string(), buffer.read_uint32()))
            elif end is None:
                _read_unsized(kind, buffer, version, found)
            if end is not None:
                buffer.skip_to(end)
    except _DAMAGED as error:
        if not wanted or not set(wanted) <= {name for name, _ in found}:
            raise CommunicationError(f"the model definitions cannot be read: {error}") from error
    return found


def _read_unsized(kind: int, buffer: BoundedBuffer, version: tuple[int, int], found: list[tuple[str, int]]) -> None:
    """A definition that does not tell its size: it has to be read to be left."""
    if kind == _PLATE:  # natnet reads three of the four corners
        buffer.read_uint32(), buffer.read_string(), buffer.read_float32_array(2 + 3 + 12 * 12 + 4 * 3)
        buffer.read_uint32(), buffer.read_uint32()
        for _ in range(buffer.read_uint32()):
            buffer.read_string()
        return
    kinds = {0: MarkerSetDescription, _BODY: RigidBodyDescription, 2: SkeletonDescription}
    kinds |= {4: DeviceDescription, 5: CameraDescription}
    if kind not in kinds:
        raise ValueError(f"no definition of kind {kind} is known")
    content = kinds[kind].read_from_buffer(buffer, Version(*version))
    if kind == _BODY:
        found.append((str(content.name), int(content.id_num)))


def _elements() -> dict[str, Any]:
    """What reads one element of a section."""
    return {
        "marker sets": MarkerSet,
        "rigid bodies": RigidBody,
        "skeletons": Skeleton,
        "labelled markers": LabeledMarker,
        "force plates": ForcePlate,
        "devices": Device,
    }


def read_frame(buffer: BoundedBuffer, version: tuple[int, int]) -> Frame:
    """Reads a frame: its rigid bodies and stamps. All else is skipped, by its size where the version tells it.

    Two bodies of one id are neither of them in the frame: nobody knows which is which.

    Raises:
        CommunicationError: It is damaged, or its only stamp is no number.
    """
    try:
        sequence, bodies = buffer.read_uint32(), list[Any]()
        spoken, kinds = Version(*version), _elements()
        for section in _SECTIONS if version >= _SIZED else (s for s in _SECTIONS if s != "assets"):
            count = buffer.read_uint32()
            end = buffer.read_uint32() + buffer.pointer if version >= _SIZED else None
            if section == "unlabelled markers" and end is None:
                buffer.read_float32_array(3 * count)
            elif section == "rigid bodies" or end is None:
                elements = [kinds[section].read_from_buffer(buffer, spoken) for _ in range(count)]
                bodies = elements if section == "rigid bodies" else bodies
            if end is not None:
                buffer.skip_to(end)
        suffix = FrameSuffix.read_from_buffer(buffer, spoken)
    except _DAMAGED as error:
        raise CommunicationError(f"a frame cannot be read: {error}") from error
    often = Counter(body.id_num for body in bodies)
    frame = Frame(
        sequence,
        {b.id_num: BodyPose(tuple(b.pos), tuple(b.rot), b.tracking_valid) for b in bodies if often[b.id_num] == 1},
        suffix.timestamp,
        suffix.stamp_camera_mid_exposure,
        suffix.stamp_transmit,
    )
    frame.times(1)
    return frame
