"""The emulated Feetech bus: what its servos do with instructions."""

from __future__ import annotations

from hardware.emulators.feetech.motor import RESPONSE, STATUS, Motor
from hardware.emulators.feetech.packet import Instruction, Parser, frame
from hardware.emulators.line import Line

PING, READ, WRITE, SYNC_READ, SYNC_WRITE = 1, 2, 3, 0x82, 0x83
STS3215 = 777


class FeetechLine(Line):
    """See `Line`."""

    motors: dict[int, Motor]

    def new_motor(self, identity: int, position: int, now: float) -> Motor:
        return Motor(identity, position, now, self.models.get(identity, STS3215))

    def new_parser(self) -> Parser:
        return Parser()

    def status(self, identity: int, error: int, data: bytes) -> bytes:
        return frame(identity, self.motors[identity].memory[STATUS], data)

    def answers(self, instruction: Instruction, now: float) -> list[bytes]:
        p = instruction.parameters
        if instruction.code == SYNC_READ:
            return [self.reply(k, 0, self.motors[k].read(p[0], p[1])) for k in p[2:] if self.hears(k)]
        if instruction.code == SYNC_WRITE:
            address, length = p[0], p[1]
            for start in range(2, len(p), 1 + length):
                if self.hears(p[start]):
                    self.motors[p[start]].write(address, p[start + 1 : start + 1 + length], now)
            return []
        identity = instruction.identity
        if not self.hears(identity):
            return []
        motor = self.motors[identity]
        if instruction.code == PING:
            return [self.reply(identity, 0)]
        if instruction.code == READ:
            return [self.reply(identity, 0, motor.read(p[0], p[1]))]
        if instruction.code == WRITE:
            motor.write(p[0], p[1:], now)
            return [self.reply(identity, 0)] if motor.memory[RESPONSE] else []
        return []

    def _report(self, motor: Motor) -> dict[str, object]:
        return super()._report(motor) | {"calibrated": motor.calibrated}
