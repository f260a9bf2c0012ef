"""Packets of Feetech's protocol, from the maker's description of it and not from its SDK."""

from __future__ import annotations

from typing import NamedTuple

HEADER = b"\xff\xff"
LONGEST = 250


def checksum(body: bytes) -> int:
    """Of what lies between header and checksum."""
    return ~sum(body) & 0xFF


def frame(identity: int, first: int, parameters: bytes = b"") -> bytes:
    """A whole packet: an instruction or a status, and what goes with it."""
    body = bytes([identity, len(parameters) + 2, first]) + parameters
    return HEADER + body + bytes([checksum(body)])


class Instruction(NamedTuple):
    """A packet to the servos."""

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
                del self.buffer[: max(0, len(self.buffer) - 1)]
                return found
            del self.buffer[:start]
            if len(self.buffer) < 4:
                return found
            end = 4 + self.buffer[3]
            if not 6 <= end <= LONGEST:
                del self.buffer[:1]
                self.bad += 1
                continue
            if len(self.buffer) < end:
                return found
            packet = bytes(self.buffer[:end])
            if checksum(packet[2:-1]) != packet[-1]:
                del self.buffer[:1]
                self.bad += 1
                continue
            del self.buffer[:end]
            found.append(Instruction(packet[2], packet[4], packet[5:-1]))
