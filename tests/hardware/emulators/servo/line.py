"""The emulated bus: a pseudo terminal, its motors, and the faults that are asked for."""

from __future__ import annotations

import contextlib
import mmap
import os
import struct
import time
import tty
from pathlib import Path
from typing import Any

from hardware.emulators.servo.motor import ALERT, HARDWARE_ERROR, INSTRUCTION, TORQUE, WATCHDOG, Motor
from hardware.emulators.servo.packet import Instruction, Parser, frame, status

PING, READ, WRITE, REBOOT, SYNC_READ, SYNC_WRITE = 1, 2, 3, 8, 0x82, 0x83
BROADCAST = 0xFE
REPLY_FAULTS = ("mute", "corrupt", "short", "cut", "late")


def positions_file(link: Path) -> Path:
    """Where the motors' positions are told, in ticks, as float64 in the order of the motors: an arm may follow them."""
    return link.with_name(f"{link.name}.positions")


class Line:
    """Motors on a pseudo terminal that is reached by the name `link`."""

    def __init__(self, link: Path, motors: dict[int, int]) -> None:
        self.link = link
        self.start = motors
        with positions_file(link).open("w+b") as file:
            file.truncate(8 * len(motors))
            self.told = mmap.mmap(file.fileno(), 0)
        self.master = self.slave = -1
        self.fresh()
        self.plug()

    def fresh(self) -> None:
        """New motors at their start positions, and no faults."""
        now = time.monotonic()
        self.motors = {identity: Motor(identity, position, now) for identity, position in self.start.items()}
        self.faults: dict[int, tuple[str, int, float]] = {}  # kind, replies left (negative: all), amount
        self.parser = Parser()
        self._tell()

    def _tell(self) -> None:
        positions = [motor.position for motor in self.motors.values()]
        self.told[:] = struct.pack(f"={len(positions)}d", *positions)

    def plug(self) -> None:
        """Opens the terminal; the slave stays open here, so that a driver may come and go."""
        self.master, self.slave = os.openpty()
        tty.setraw(self.slave)
        self.link.unlink(missing_ok=True)
        self.link.symlink_to(os.ttyname(self.slave))

    def unplug(self) -> None:
        """Closes the terminal: the driver's end is dead for good, and the name is gone."""
        self.link.unlink(missing_ok=True)
        for end in (self.master, self.slave):
            if end >= 0:
                os.close(end)
        self.master = self.slave = -1

    def receive(self) -> None:
        """Takes what has come, and answers it."""
        now = time.monotonic()
        for motor in self.motors.values():
            motor.advance(now)
        for instruction in self.parser.feed(os.read(self.master, 4096)):
            replies = b"".join(self._answers(instruction, now))
            with contextlib.suppress(BlockingIOError):
                while replies:
                    replies = replies[os.write(self.master, replies) :]
        self._tell()

    def _answers(self, instruction: Instruction, now: float) -> list[bytes]:
        p = instruction.parameters
        if instruction.code == SYNC_READ:
            address, length = int.from_bytes(p[:2], "little"), int.from_bytes(p[2:4], "little")
            return [self._read(k, address, length, now) for k in p[4:] if self._hears(k)]
        if instruction.code == SYNC_WRITE:
            address, length = int.from_bytes(p[:2], "little"), int.from_bytes(p[2:4], "little")
            for start in range(4, len(p), 1 + length):
                if self._hears(p[start]):
                    self._write(p[start], address, p[start + 1 : start + 1 + length], now)
            return []
        identity = instruction.identity
        if not self._hears(identity):
            return []
        motor = self.motors[identity]
        if instruction.code == PING:
            motor.fed = now
            return [self._reply(identity, 0, bytes([*motor.memory[0:2], motor.memory[6]]))]
        if instruction.code == READ:
            return [self._read(identity, int.from_bytes(p[:2], "little"), int.from_bytes(p[2:4], "little"), now)]
        if instruction.code == WRITE:
            return [self._reply(identity, self._write(identity, int.from_bytes(p[:2], "little"), p[2:], now))]
        if instruction.code == REBOOT:
            motor.restart(now)
            return [self._reply(identity, 0)]
        return [self._reply(identity, INSTRUCTION)]

    def _spend(self, identity: int) -> tuple[str, float]:
        """The fault that is pending for a motor, counted down; ("", 0) if there is none."""
        kind, count, amount = self.faults.get(identity, ("", -1, 0))
        if count == 1:
            del self.faults[identity]
        elif kind:
            self.faults[identity] = (kind, count - 1, amount)
        return kind, amount

    def _hears(self, identity: int) -> bool:
        """Whether the motor is there; nothing reaches a mute one, as if its cable were off."""
        mute = self.faults.get(identity, ("",))[0] == "mute"
        if mute:
            self._spend(identity)
        return identity in self.motors and not mute

    def _read(self, identity: int, address: int, length: int, now: float) -> bytes:
        self.motors[identity].fed = now
        return self._reply(identity, *self.motors[identity].read(address, length))

    def _write(self, identity: int, address: int, data: bytes, now: float) -> int:
        self.motors[identity].fed = now
        return self.motors[identity].write(address, data, now)

    def _reply(self, identity: int, error: int, data: bytes = b"") -> bytes:
        """The status packet, spoilt if a fault is pending."""
        alert = ALERT if self.motors[identity].memory[HARDWARE_ERROR] else 0
        whole = status(identity, error | alert, data)
        kind, amount = self._spend(identity)
        if kind == "corrupt":
            return whole[:-3] + bytes([whole[-3] ^ 0x10]) + whole[-2:]
        if kind == "short":  # a sound packet with too few bytes of data
            return frame(identity, bytes([0x55, error | alert]) + data[: max(0, len(data) - int(amount))])
        if kind == "cut":
            return whole[: len(whole) - int(amount)]
        if kind == "late":
            time.sleep(amount)
        return whole

    def command(self, order: dict[str, Any]) -> dict[str, Any]:
        """Carries out one order of a test; returns the answer."""
        now = time.monotonic()
        for motor in self.motors.values():
            motor.advance(now)
        do = order["do"]
        if do in REPLY_FAULTS:
            self.faults[order["id"]] = (do, order.get("count", -1), order.get("amount", 1))
        elif do == "heal":
            self.faults.clear()
        elif do in ("fresh", "plug", "unplug"):
            getattr(self, do)()
        elif do == "poke":
            self.motors[order["id"]].put(order["address"], order["length"], order["value"])
        elif do == "peek":
            motor = self.motors[order["id"]]
            return {"value": motor.get(order["address"], order["length"], order.get("signed", False))}
        elif do == "turn":
            self.motors[order["id"]].position = float(order["position"])
            self.motors[order["id"]].advance(now)
        elif do == "load":
            self.motors[order["id"]].load = order["current"]
        elif do == "trip":
            self.motors[order["id"]].fed = -1e9
            self.motors[order["id"]].advance(now)
        elif do == "restart":
            self.motors[order["id"]].restart(now)
        elif do == "track":
            self.motors[order["id"]].tracks = True
        elif do == "overload":
            self.motors[order["id"]].overload()
        elif do == "report":
            return {str(identity): self._report(motor) for identity, motor in self.motors.items()}
        else:
            return {"error": f"unknown order {do!r}"}
        return {}

    def _report(self, motor: Motor) -> dict[str, Any]:
        return {
            "position": motor.position,
            "goal": motor.get(116, 4, True),
            "torque": motor.memory[TORQUE],
            "tripped": motor.memory[WATCHDOG] == 0xFF,
            "held": motor.held,
            "goals": motor.goals,
            "refused": motor.refused,
            "bad_packets": self.parser.bad,
        }
