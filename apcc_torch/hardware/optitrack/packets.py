"""NatNet datagrams: requests to the server, and its answers and frames read with the `natnet` package's parser.

Known are the bit stream versions 3.0 to 4.2. The parser trusts every count that a datagram holds, so its buffer is
bounded here: a damaged count ends in an error at once, not in gigabytes or minutes. It misreads the end of a frame from
4.1 on (the frame's parameters); only what stands before that is used.
"""

from __future__ import annotations

import math
import struct
from dataclasses import dataclass
from typing import Any

from apcc_torch.errors import CommunicationError, HardwareError

try:
    from natnet.data_descriptions import DataDescriptions
    from natnet.data_frame import DataFrame
    from natnet.exceptions import NatNetError
    from natnet.packet_buffer import PacketBuffer
    from natnet.server_info import ServerInfo
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
MAX_DATAGRAM = 65535

_HEADER = struct.Struct("<HH")  # message, bytes that follow
_TICK_RATE = struct.Struct("<Q")

# What the parser raises over a damaged datagram.
_DAMAGED = (struct.error, ValueError, IndexError, OverflowError, NatNetError)


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
class BodyPose:
    """A rigid body of a frame: position (x, y, z) in streamed units, quaternion (x, y, z, w), tracked or not."""

    position: tuple[float, float, float]
    quaternion: tuple[float, float, float, float]
    tracked: bool


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
        """
        if tick_rate > 0 and 0 < self.mid_exposure <= self.transmit:
            return self.mid_exposure / tick_rate, self.transmit / tick_rate, True
        return self.timestamp, self.timestamp, False


class BoundedBuffer(PacketBuffer):
    """The parser's buffer, which never reads beyond its end."""

    def read_string(self, max_length: int | None = None, static_length: bool = False) -> str:
        end = len(self.data) if max_length is None else self.pointer + max_length
        if end > len(self.data) or b"\0" not in bytes(self.data[self.pointer : end]):
            raise ValueError("a text does not end within the datagram")
        return str(super().read_string(max_length, static_length))

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
        info = ServerInfo.read_from_buffer(buffer, Version(0))
        rest = len(buffer.data) - buffer.pointer
        tick_rate = buffer.read(_TICK_RATE)[0] if rest >= _TICK_RATE.size else 0
    except _DAMAGED as error:
        raise CommunicationError(f"the server's answer cannot be read: {error}") from error
    major, minor = info.nat_net_protocol_version.components[:2]
    return Server(info.application_name, (int(major), int(minor)), int(tick_rate))


def check_version(server: Server) -> None:
    """Refuses a bit stream that is not known.

    Raises:
        HardwareError: The version is none of `KNOWN_VERSIONS`.
    """
    if server.version not in KNOWN_VERSIONS:
        known = ", ".join(f"{major}.{minor}" for major, minor in KNOWN_VERSIONS)
        spoken = ".".join(map(str, server.version))
        raise HardwareError(f"the server {server.name!r} streams NatNet {spoken}; known are {known}")


def read_body_ids(buffer: BoundedBuffer, version: tuple[int, int]) -> dict[str, int]:
    """Reads the model definitions: rigid bodies' streaming ids by name.

    Raises:
        CommunicationError: They are damaged, or name two rigid bodies alike.
    """
    try:
        bodies = DataDescriptions.read_from_buffer(buffer, Version(*version)).rigid_bodies
    except _DAMAGED as error:
        raise CommunicationError(f"the model definitions cannot be read: {error}") from error
    ids = {str(body.name): int(body.id_num) for body in bodies}
    if len(ids) != len(bodies):
        raise CommunicationError("the server has two rigid bodies of one name")
    return ids


def read_frame(buffer: BoundedBuffer, version: tuple[int, int]) -> Frame:
    """Reads a frame.

    Raises:
        CommunicationError: It is damaged, or holds two rigid bodies of one id.
    """
    try:
        content = DataFrame.read_from_buffer(buffer, Version(*version))
    except _DAMAGED as error:
        raise CommunicationError(f"a frame cannot be read: {error}") from error
    bodies = {
        body.id_num: BodyPose(tuple(body.pos), tuple(body.rot), body.tracking_valid) for body in content.rigid_bodies
    }
    if len(bodies) != len(content.rigid_bodies):
        raise CommunicationError("a frame holds two rigid bodies of one id")
    suffix = content.suffix
    if not math.isfinite(suffix.timestamp):
        raise CommunicationError(f"a frame is stamped {suffix.timestamp}")
    return Frame(
        content.prefix.frame_number, bodies, suffix.timestamp, suffix.stamp_camera_mid_exposure, suffix.stamp_transmit
    )
