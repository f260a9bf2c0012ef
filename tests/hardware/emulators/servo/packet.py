"""Protocol 2.0 packets, from the maker's description of the protocol and not from its SDK."""

from __future__ import annotations

from typing import NamedTuple

HEADER = b"\xff\xff\xfd\x00"
STATUS = 0x55


def _crc_table() -> list[int]:
    """CRC-16 with the polynomial 0x8005, most significant bit first, no reflection, starting from 0."""
    table = []
    for byte in range(256):
        crc = byte << 8
        for _ in range(8):
            crc = (crc << 1) ^ 0x8005 if crc & 0x8000 else crc << 1
        table.append(crc & 0xFFFF)
    return table


TABLE = _crc_table()


def crc16(data: bytes) -> int:
    crc = 0
    for byte in data:
        crc = (crc << 8 & 0xFF00) ^ TABLE[crc >> 8 ^ byte]
    return crc


def stuff(body: bytes) -> bytes:
    """Breaks up the header's first three bytes where they occur in instruction and parameters."""
    return body.replace(b"\xff\xff\xfd", b"\xff\xff\xfd\xfd")


def unstuff(body: bytes) -> bytes:
    return body.replace(b"\xff\xff\xfd\xfd", b"\xff\xff\xfd")


def frame(identity: int, body: bytes) -> bytes:
    """A whole packet; `body` is what lies between the length and the checksum, not yet stuffed."""
    stuffed = stuff(body)
    packet = HEADER + bytes([identity]) + (len(stuffed) + 2).to_bytes(2, "little") + stuffed
    return packet + crc16(packet).to_bytes(2, "little")


def status(identity: int, error: int, data: bytes = b"") -> bytes:
    return frame(identity, bytes([STATUS, error]) + data)


class Instruction(NamedTuple):
    """A packet to the motors."""

    identity: int
    code: int
    parameters: bytes


class Parser:
    """Finds the packets in a stream of bytes; drops what is none, or has a wrong checksum."""

    def __init__(self) -> None:
        self.buffer = bytearray()
        self.bad = 0

    def feed(self, data: bytes) -> list[Instruction]:
        self.buffer += data
        found = []
        while True:
            start = self.buffer.find(HEADER)
            if start < 0:
                del self.buffer[: max(0, len(self.buffer) - 3)]
                return found
            del self.buffer[:start]
            if len(self.buffer) < 7:
                return found
            end = 7 + int.from_bytes(self.buffer[5:7], "little")
            if not 10 <= end <= 1031:
                del self.buffer[:4]
                self.bad += 1
                continue
            if len(self.buffer) < end:
                return found
            packet = bytes(self.buffer[:end])
            if crc16(packet[:-2]) != int.from_bytes(packet[-2:], "little"):
                del self.buffer[:4]
                self.bad += 1
                continue
            del self.buffer[:end]
            if HEADER[:3] in packet[7:-2].replace(stuff(HEADER[:3]), b"\0"):  # a servo would take it for a new packet
                self.bad += 1
                continue
            body = unstuff(packet[7:-2])
            found.append(Instruction(packet[4], body[0], body[1:]))
