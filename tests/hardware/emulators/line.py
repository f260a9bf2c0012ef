"""An emulated bus of servos: a pseudo terminal, its motors, and the faults that are asked for."""

from __future__ import annotations

import contextlib
import mmap
import os
import struct
import time
import tty
from abc import ABC, abstractmethod
from collections.abc import Iterable
from pathlib import Path
from typing import Any

REPLY_FAULTS = ("mute", "corrupt", "short", "cut", "late")


def positions_file(link: Path) -> Path:
    """Where the motors' positions are told, in ticks, as float64 in the order of the motors: an arm may follow them."""
    return link.with_name(f"{link.name}.positions")


class Line(ABC):
    """Motors on a pseudo terminal that is reached by the name `link`; a subclass speaks their protocol.

    Args:
        link: The name.
        motors: id -> start position in ticks.
        models: id -> model number, where it is not the protocol's usual one.
    """

    motors: dict[int, Any]

    def __init__(self, link: Path, motors: dict[int, int], models: dict[int, int]) -> None:
        self.link = link
        self.start = motors
        self.models = models
        with positions_file(link).open("w+b") as file:
            file.truncate(8 * len(motors))
            self.told = mmap.mmap(file.fileno(), 0)
        self.master = self.slave = -1
        self.fresh()
        self.plug()

    @abstractmethod
    def new_motor(self, identity: int, position: int, now: float) -> Any:
        """A motor as from the factory, at a position."""

    @abstractmethod
    def new_parser(self) -> Any:
        """Finds instructions in bytes by its `feed`, and counts those that are none as `bad`."""

    @abstractmethod
    def answers(self, instruction: Any, now: float) -> Iterable[bytes]:
        """Carries out an instruction; the replies."""

    @abstractmethod
    def status(self, identity: int, error: int, data: bytes) -> bytes:
        """A whole status packet."""

    def fresh(self) -> None:
        """New motors at their start positions, and no faults."""
        now = time.monotonic()
        self.motors = {identity: self.new_motor(identity, position, now) for identity, position in self.start.items()}
        self.faults: dict[int, tuple[str, int, float]] = {}  # kind, replies left (negative: all), amount
        self.parser = self.new_parser()
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
            replies = b"".join(self.answers(instruction, now))
            with contextlib.suppress(BlockingIOError):
                while replies:
                    replies = replies[os.write(self.master, replies) :]
        self._tell()

    def _spend(self, identity: int) -> tuple[str, float]:
        """The fault that is pending for a motor, counted down; ("", 0) if there is none."""
        kind, count, amount = self.faults.get(identity, ("", -1, 0))
        if count == 1:
            del self.faults[identity]
        elif kind:
            self.faults[identity] = (kind, count - 1, amount)
        return kind, amount

    def hears(self, identity: int) -> bool:
        """Whether the motor is there; nothing reaches a mute one, as if its cable were off."""
        mute = self.faults.get(identity, ("",))[0] == "mute"
        if mute:
            self._spend(identity)
        return identity in self.motors and not mute

    def reply(self, identity: int, error: int, data: bytes = b"") -> bytes:
        """The status packet, spoilt if a fault is pending."""
        whole = self.status(identity, error, data)
        kind, amount = self._spend(identity)
        if kind == "corrupt":
            return whole[:-3] + bytes([whole[-3] ^ 0x10]) + whole[-2:]
        if kind == "short":  # a sound packet with too few bytes of data
            return self.status(identity, error, data[: max(0, len(data) - int(amount))])
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
        elif do == "report":
            return {str(identity): self._report(motor) for identity, motor in self.motors.items()}
        elif do == "peek":
            motor = self.motors[order["id"]]
            return {"value": motor.get(order["address"], order["length"], order.get("signed", False))}
        elif do in ("poke", "turn", "load", "trip", "restart", "track", "overload"):
            self._trouble(self.motors[order["id"]], do, order, now)
        else:
            return {"error": f"unknown order {do!r}"}
        return {}

    def _trouble(self, motor: Any, do: str, order: dict[str, Any], now: float) -> None:
        if do == "poke":
            motor.put(order["address"], order["length"], order["value"])
        elif do == "turn":
            motor.position = float(order["position"])
        elif do == "load":
            motor.load = order["current"]
        elif do == "trip":
            motor.fed = -1e9
        elif do == "restart":
            motor.restart(now)
        elif do == "track":
            motor.tracks = True
        else:
            motor.overload()
        motor.advance(now)

    def _report(self, motor: Any) -> dict[str, Any]:
        return {
            "position": motor.position,
            "goal": motor.goal,
            "resting": motor.resting,
            "torque": motor.torque,
            "tripped": motor.tripped,
            "held": motor.held,
            "goals": motor.goals,
            "told": motor.told,
            "reach": motor.reach,
            "refused": motor.refused,
            "bad_packets": self.parser.bad,
        }
