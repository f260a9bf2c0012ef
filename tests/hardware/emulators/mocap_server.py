"""A server of motion capture in a process of its own, on loopback, with faults on demand; each make derives from it.

Poses come from a list or a function of time, or are pushed with `set_poses`; they get a little noise, as real ones
have.
"""

from __future__ import annotations

import multiprocessing
import os
import select
import socket
import time
from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from multiprocessing.connection import Connection
from typing import Any, ClassVar, Self

import numpy as np

Poses = np.ndarray  # (k, 7) or (N, k, 7): position, quaternion x y z w
PoseFunction = Callable[[float], Poses]

EXPOSURE_TO_TRANSMIT = 0.004  # s


def standing(bodies: int) -> Poses:
    """Bodies under each other, 0.12 m apart, turned differently."""
    poses = np.zeros((bodies, 7))
    for k in range(bodies):
        poses[k, :3] = (0.3, -0.2, 1.5 - 0.12 * k)
        poses[k, 3:] = (np.sin(0.1 * k), 0, 0, np.cos(0.1 * k))
    return poses


@dataclass(frozen=True)
class ServerOptions:
    """What the server streams.

    `poses` is an array (k, 7), a list of frames (N, k, 7) that is played round and round, or a function of the time in
    s since the start that gives (k, 7); a function must be importable by another process.
    """

    names: Mapping[int, str]
    poses: Poses | PoseFunction
    rate: float = 100.0
    version: tuple[int, int] = (4, 1)
    address: str = "127.0.0.1"
    group: str | None = None  # streams by multicast
    data_port: int = 0
    ticks: bool = True  # high-resolution stamps
    noise: float = 1e-5  # m
    drift: float = 0.0  # the server's clock runs faster by this, s/s
    extras: bool = True


@dataclass
class Faults:
    """What goes wrong. Bodies are named by their number."""

    untracked: list[int] = field(default_factory=list)  # and repeats its last pose
    missing: list[int] = field(default_factory=list)
    frozen: list[int] = field(default_factory=list)  # tracked, with the very same numbers
    jump: dict[int, tuple[float, float, float]] = field(default_factory=dict)
    swap: tuple[int, int] | None = None
    nan: list[int] = field(default_factory=list)
    zero_quaternion: list[int] = field(default_factory=list)
    stretch: dict[int, float] = field(default_factory=dict)  # of the quaternion's length
    frozen_number: bool = False
    delay: float = 0.0  # s between stamping and sending
    truncate: int | None = None  # bytes that are left
    garbage: int = 0  # random datagrams with each frame
    stop: bool = False  # streams nothing
    mute: bool = False  # answers nothing
    duplicate: bool = False
    reorder: bool = False  # every two frames change places
    foreign: str | None = None  # another address that sends wrong frames too
    clock_step: float = 0.0  # s


@dataclass
class Body:
    """One rigid body as it is: quaternion x, y, z, w."""

    number: int
    position: np.ndarray
    quaternion: np.ndarray
    tracked: bool = True


class MocapServer:
    """Runs a server in a process; a context manager. A make of its own names its `process`."""

    process: ClassVar[Callable[[Connection, ServerOptions], None]]
    version: ClassVar[tuple[int, int]] = (4, 1)

    def __init__(
        self, names: Mapping[int, str] | None = None, poses: Poses | PoseFunction | None = None, **options: Any
    ) -> None:
        names = names or {1: "base", 2: "disk_1", 3: "disk_2", 4: "disk_3"}
        options = {"version": type(self).version, **options}
        self.options = ServerOptions(names, standing(len(names)) if poses is None else poses, **options)
        context = multiprocessing.get_context("spawn")
        self._pipe, other = context.Pipe()
        self._process = context.Process(target=type(self).process, args=(other, self.options), daemon=True)
        self._other = other
        self.command_port = self.data_port = 0

    def __enter__(self) -> Self:
        self._process.start()
        self._other.close()  # so that the process sees the end of this one
        self.command_port, self.data_port = self._answer(timeout=30.0)
        return self

    def __exit__(self, *_: object) -> None:
        self._pipe.close()
        self._process.join(5.0)
        if self._process.is_alive():
            self._process.kill()
            self._process.join()

    def kill(self) -> None:
        """Ends it at once, as a crash would."""
        self._process.kill()
        self._process.join()

    @property
    def pid(self) -> int:
        return int(self._process.pid or 0)

    def fault(self, **faults: Any) -> int:
        """Sets `Faults` by name; what is not named goes right again. Returns the last frame's number before that."""
        return int(self._call("fault", Faults(**faults)))

    def set_poses(self, poses: Poses | PoseFunction) -> int:
        """Sets the poses. Returns the last frame's number before that."""
        return int(self._call("poses", poses))

    def restart(self, **options: Any) -> None:
        """Begins anew, as a server that was started again: frame 0, a new clock, no clients; options may change."""
        self._call("restart", options)

    def _call(self, what: str, value: Any) -> Any:
        self._pipe.send((what, value))
        return self._answer()

    def _answer(self, timeout: float = 5.0) -> Any:
        if not self._pipe.poll(timeout):
            raise TimeoutError("the server does not answer")
        return self._pipe.recv()


class Server(ABC):
    """The server's side, in its own process: a make says how a frame is written, where it goes, and how it answers."""

    def __init__(self, pipe: Connection, options: ServerOptions) -> None:
        self.pipe, self.options, self.faults = pipe, options, Faults()
        self.others: dict[str, socket.socket] = {}
        self.random = np.random.default_rng(int.from_bytes(os.urandom(4), "little"))
        self.begin()

    @abstractmethod
    def encoded(self, sequence: int, bodies: list[Body], stamp: float) -> bytes:
        """A frame as it is sent."""

    @abstractmethod
    def send(self, data: bytes, foreign: str | None = None) -> None:
        """Sends it to whoever listens, perhaps from another address."""

    @abstractmethod
    def answer(self) -> None:
        """Answers what has been asked."""

    @property
    @abstractmethod
    def sockets(self) -> list[socket.socket]:
        """Those on which questions come."""

    @property
    @abstractmethod
    def ports(self) -> tuple[int, int]:
        """Of commands and of data."""

    def begin(self) -> None:
        """Frame 0, a new clock, no clients."""
        self.sequence, self.began = 0, time.monotonic()
        self.last: dict[int, Body] = {}
        self.queue: list[tuple[float, bytes]] = []
        self.held: bytes | None = None

    def clock(self) -> float:
        """The server's clock, s."""
        return (time.monotonic() - self.began) * (1.0 + self.options.drift) + 1000.0 + self.faults.clock_step

    def bodies(self) -> list[Body]:
        f, o = self.faults, self.options
        now = time.monotonic() - self.began
        poses = o.poses(now) if callable(o.poses) else np.asarray(o.poses)
        if poses.ndim == 3:
            poses = poses[self.sequence % len(poses)]
        poses = poses.copy()
        poses[:, :3] += self.random.normal(0.0, o.noise, (len(poses), 3)) if o.noise else 0.0
        found = {}
        for row, number in enumerate(o.names):
            body = Body(number, poses[row, :3] + f.jump.get(number, 0.0), poses[row, 3:] * f.stretch.get(number, 1.0))
            if number in f.zero_quaternion:
                body.quaternion = np.zeros(4)
            if number in f.nan:
                body.position = np.full(3, np.nan)
            if number in f.untracked or number in f.frozen:
                body = replace(self.last.get(number, body), tracked=number not in f.untracked)
            found[number] = body
        self.last = dict(found)
        if f.swap is not None:
            one, two = f.swap
            found[one], found[two] = replace(found[two], number=one), replace(found[one], number=two)
        return [body for number, body in found.items() if number not in f.missing]

    def tick(self) -> None:
        """Makes a frame and sends what is due."""
        f = self.faults
        now = time.monotonic()
        if not f.stop:
            self.sequence += 0 if f.frozen_number else 1
            stamp, bodies = self.clock(), self.bodies()
            data = self.encoded(self.sequence, bodies, stamp)
            if f.foreign is not None:
                wrong = [replace(body, position=np.asarray(body.position) + 1.0) for body in bodies]
                self.send(self.encoded(self.sequence + 1000, wrong, stamp), f.foreign)
            if f.truncate is not None:
                data = data[: f.truncate]
            for _ in range(f.garbage):
                self.send(self.random.bytes(int(self.random.integers(1, 400))))
            self.emit(data, now + f.delay)
        while self.queue and self.queue[0][0] <= time.monotonic():
            self.send(self.queue.pop(0)[1])

    def emit(self, data: bytes, due: float) -> None:
        if self.faults.reorder and self.held is None:
            self.held = data
            return
        self.queue.append((due, data))
        if self.held is not None:
            self.queue.append((due, self.held))
            self.held = None
        if self.faults.duplicate:
            self.queue.append((due, data))

    def obey(self) -> None:
        what, value = self.pipe.recv()
        before = self.sequence
        if what == "fault":
            self.faults = value
        elif what == "poses":
            self.options = replace(self.options, poses=value)
        elif what == "restart":
            self.options = replace(self.options, **value)
            self.begin()
        self.pipe.send(before)

    def serve(self) -> None:
        """Until the other end of the pipe is closed."""
        self.pipe.send(self.ports)
        due = time.monotonic()
        while True:
            waiting = max(0.0, due - time.monotonic())
            ready, _, _ = select.select([self.pipe, *self.sockets], [], [], waiting)
            if self.pipe in ready:
                try:
                    self.obey()
                except EOFError:
                    return
            if set(ready) - {self.pipe}:
                self.answer()
            if time.monotonic() >= due:
                self.tick()
                due = max(due + 1.0 / self.options.rate, time.monotonic() - 0.1)
