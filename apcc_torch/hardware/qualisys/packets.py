"""Packets of QTM's real-time protocol: framing, the bodies' names, and frames read with the `qtm-rt` package's parser.

The parser trusts every size and count that a packet holds, and a component of no size would keep it busy for hours; so
a packet's outline is checked here first. Rotation matrices come column by column, lengths in mm, and a body that is not
tracked as NaN.
"""

from __future__ import annotations

import struct
import xml.etree.ElementTree as ElementTree
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch

from apcc_torch.errors import CommunicationError
from apcc_torch.hardware.mocap.bodies import BodyPose
from apcc_torch.lie.rotations import rotation_quaternion

try:
    from qtm_rt.packet import QRTPacket, QRTPacketType, RTComponentData, RTDataQRTPacket, RTheader
except ModuleNotFoundError:  # the settings can be read all the same; who builds the sensor is told
    QRTPacket = QRTPacketType = RTComponentData = RTDataQRTPacket = RTheader = None

VERSION = "1.25"
"""Of the protocol that is asked for; QTM speaks all versions before its own."""
WELCOME = "QTM RT Interface connected"
VERSION_SET = "Version set to"
MICROSECONDS = 1_000_000
"""Ticks per second of a frame's stamp."""
ERROR, COMMAND, XML, DATA, NO_MORE_DATA, EVENT = 0, 1, 2, 3, 4, 6
CHANGED = (3, 8, 11, 14)
"""Events after which the bodies may be others: capture, playing from a file, settings, reprocessing."""
MAX_PACKET = 1 << 20
"""Bytes; a longer one is no packet, but a stream that has lost its order."""

_HEADER = 8
_TOLERANCE = 5e-3  # of the entries of R^T R - I
_DAMAGED = (struct.error, ValueError, IndexError, KeyError, OverflowError)


@dataclass(frozen=True)
class QualisysFrame:
    """One frame of QTM.

    Attributes:
        sequence: Frame number.
        bodies: Rigid bodies by their place among those of the parameters.
        microseconds: When its markers were measured, since the measurement began.
    """

    sequence: int
    bodies: dict[int, BodyPose]
    microseconds: int

    def times(self, tick_rate: int) -> tuple[float, float, bool]:
        """When it was measured, s of the cameras' clock, twice: when it was sent, QTM does not tell."""
        measured = self.microseconds / tick_rate
        return measured, measured, False


def command(text: str) -> bytes:
    """A command to QTM."""
    body = text.encode() + b"\0"
    return bytes(RTheader.pack(_HEADER + len(body), COMMAND)) + body


def split(data: bytes) -> tuple[list[tuple[int, bytes]], bytes]:
    """The whole packets, (type, body), that a stream begins with, and what is left of it.

    Raises:
        CommunicationError: A size is none: the stream has lost its order.
    """
    packets = []
    while len(data) >= _HEADER:
        size, kind = RTheader.unpack_from(data)
        if not _HEADER <= size <= MAX_PACKET:
            raise CommunicationError(f"a packet says that it has {size} bytes")
        if len(data) < size:
            break
        packets.append((kind, data[_HEADER:size]))
        data = data[size:]
    return packets, data


def open_datagram(data: bytes) -> tuple[int, bytes]:
    """Type and body of a packet that came alone.

    Raises:
        CommunicationError: It is cut, or longer than it says.
    """
    size, kind = RTheader.unpack_from(data) if len(data) >= _HEADER else (_HEADER, -1)
    if size != len(data):
        raise CommunicationError(f"a datagram has {len(data)} bytes and says {size}")
    return kind, data[_HEADER:]


def text_of(body: bytes) -> str:
    """The text of a command's reply, an error or an XML packet."""
    return body.rstrip(b"\0").decode("utf-8", errors="replace")


def read_bodies(body: bytes) -> list[tuple[str, int]]:
    """Names of the rigid bodies and their places in a frame, from the 6D parameters.

    Raises:
        CommunicationError: They cannot be read.
    """
    try:
        root = ElementTree.fromstring(text_of(body))
    except (ElementTree.ParseError, ValueError) as error:
        raise CommunicationError(f"the bodies' parameters cannot be read: {error}") from error
    names = (element.findtext("Name", "").strip() for element in root.findall("*/Body"))
    return [(name, k) for k, name in enumerate(names)]


def read_frame(body: bytes, expected: int) -> QualisysFrame | None:
    """A frame with its rigid bodies; None where it has no such component.

    Args:
        body: Of a data packet.
        expected: How many bodies the parameters name.

    Raises:
        CommunicationError: It is damaged, or has another number of bodies.
    """
    try:
        _check_outline(body)
        packet = QRTPacket(body)
        told = packet.get_6d()
        if told is None:
            return None
        info, bodies = told
        if info.body_count != expected or len(bodies) != expected:
            raise CommunicationError(f"a frame has {info.body_count} bodies, and the parameters name {expected}")
        return QualisysFrame(int(packet.framenumber), _poses(bodies), int(packet.timestamp))
    except _DAMAGED as error:
        raise CommunicationError(f"a damaged frame: {error}") from error


def _check_outline(body: bytes) -> None:
    """Raises ValueError where the components do not fill the packet exactly."""
    _, _, count = RTDataQRTPacket.unpack_from(body)
    place = RTDataQRTPacket.size
    for _ in range(count):
        size, _ = RTComponentData.unpack_from(body, place)
        if size < RTComponentData.size:
            raise ValueError(f"a component says that it has {size} bytes")
        place += size
    if place != len(body):
        raise ValueError(f"its components have {place} bytes of {len(body)}")


def _poses(bodies: Sequence[tuple[Any, Any]]) -> dict[int, BodyPose]:
    """Bodies from their streamed numbers; what is no rotation has a quaternion of no length, which the gate refuses."""
    positions = np.array([position for position, _ in bodies], dtype=np.float64).reshape(-1, 3)
    R = np.array([rotation.matrix for _, rotation in bodies], dtype=np.float64).reshape(-1, 3, 3).mT
    unseen = np.asarray(np.isnan(positions).all(-1) & np.isnan(R).all((-2, -1)))
    finite = np.isfinite(R).all((-2, -1))
    # Orthonormal columns, the third where the first two turn to.
    near = np.abs(R.mT @ R - np.eye(3)).max((-2, -1)) < _TOLERANCE
    handed = (np.cross(R[..., 0], R[..., 1]) * R[..., 2]).sum(-1) > 0.0
    proper = (finite & near & handed)[:, None]
    turned = torch.from_numpy(np.where(proper[..., None], R, np.eye(3)))
    with torch.inference_mode():
        quaternions = rotation_quaternion(turned).numpy()
    quaternions = np.where(proper, quaternions, np.where(finite, 0.0, np.nan)[:, None])
    rows = zip(positions.tolist(), quaternions.tolist(), unseen.tolist(), strict=True)
    return {
        k: BodyPose((x, y, z), (qx, qy, qz, qw), not gone) for k, ((x, y, z), (qx, qy, qz, qw), gone) in enumerate(rows)
    }
