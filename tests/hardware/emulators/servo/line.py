"""The emulated Dynamixel bus: what its motors do with instructions of protocol 2.0."""

from __future__ import annotations

from hardware.emulators.line import Line
from hardware.emulators.servo.models import XM430_W210
from hardware.emulators.servo.motor import ALERT, HARDWARE_ERROR, INSTRUCTION, Motor
from hardware.emulators.servo.packet import Instruction, Parser, status

PING, READ, WRITE, REBOOT, SYNC_READ, SYNC_WRITE = 1, 2, 3, 8, 0x82, 0x83


class DynamixelLine(Line):
    """See `Line`."""

    motors: dict[int, Motor]

    def new_motor(self, identity: int, position: int, now: float) -> Motor:
        return Motor(identity, position, now, self.models.get(identity, XM430_W210))

    def new_parser(self) -> Parser:
        return Parser()

    def status(self, identity: int, error: int, data: bytes) -> bytes:
        alert = ALERT if self.motors[identity].memory[HARDWARE_ERROR] else 0
        return status(identity, error | alert, data)

    def answers(self, instruction: Instruction, now: float) -> list[bytes]:
        p = instruction.parameters
        if instruction.code == SYNC_READ:
            address, length = int.from_bytes(p[:2], "little"), int.from_bytes(p[2:4], "little")
            return [self._read(k, address, length, now) for k in p[4:] if self.hears(k)]
        if instruction.code == SYNC_WRITE:
            address, length = int.from_bytes(p[:2], "little"), int.from_bytes(p[2:4], "little")
            for start in range(4, len(p), 1 + length):
                if self.hears(p[start]):
                    self._write(p[start], address, p[start + 1 : start + 1 + length], now)
            return []
        identity = instruction.identity
        if not self.hears(identity):
            return []
        motor = self.motors[identity]
        if instruction.code == PING:
            motor.fed = now
            return [self.reply(identity, 0, bytes([*motor.memory[0:2], motor.memory[6]]))]
        if instruction.code == READ:
            return [self._read(identity, int.from_bytes(p[:2], "little"), int.from_bytes(p[2:4], "little"), now)]
        if instruction.code == WRITE:
            return [self.reply(identity, self._write(identity, int.from_bytes(p[:2], "little"), p[2:], now))]
        if instruction.code == REBOOT:
            motor.restart(now)
            return [self.reply(identity, 0)]
        return [self.reply(identity, INSTRUCTION)]

    def _read(self, identity: int, address: int, length: int, now: float) -> bytes:
        self.motors[identity].fed = now
        return self.reply(identity, *self.motors[identity].read(address, length))

    def _write(self, identity: int, address: int, data: bytes, now: float) -> int:
        self.motors[identity].fed = now
        return self.motors[identity].write(address, data, now)
