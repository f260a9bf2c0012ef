"""A NatNet server in a process of its own, on loopback: Motive as far as a client can tell, with faults on demand.

    with NatNetServer(names={1: "base", 2: "disk_1"}, rate=100) as server:
        settings = OptiTrackSettings(base="base", bodies=("disk_1",), command_port=server.command_port)
        ...
        server.fault(untracked=[2])

Poses come from a list or a function of time, or are pushed with `set_poses`; they get a little noise, as real ones
have.
"""

from __future__ import annotations

import multiprocessing
import os
import select
import socket
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from multiprocessing.connection import Connection
from typing import Any, Self

import numpy as np

from hardware.emulators import natnet_layout as layout
from hardware.emulators.natnet_layout import TICK_RATE, Body, Version

Poses = np.ndarray  # (k, 7) or (N, k, 7): position, quaternion x y z w
PoseFunction = Callable[[float], Poses]

_CLIENT_LIFETIME = 3.0  # s without a word from a client
_EXPOSURE_TO_TRANSMIT = 0.004  # s


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
    version: Version = (4, 1)
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


class NatNetServer:
    """Runs the server; a context manager."""

    def __init__(
        self, names: Mapping[int, str] | None = None, poses: Poses | PoseFunction | None = None, **options: Any
    ) -> None:
        names = names or {1: "base", 2: "disk_1", 3: "disk_2", 4: "disk_3"}
        self.options = ServerOptions(names, standing(len(names)) if poses is None else poses, **options)
        context = multiprocessing.get_context("spawn")
        self._pipe, other = context.Pipe()
        self._process = context.Process(target=_serve, args=(other, self.options), daemon=True)
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
            raise TimeoutError("the NatNet server does not answer")
        return self._pipe.recv()


class _Server:
    """The server's side, in its own process."""

    def __init__(self, pipe: Connection, options: ServerOptions) -> None:
        self.pipe, self.options, self.faults = pipe, options, Faults()
        self.command = self._socket(options.address, 0)
        self.data = self._socket(options.address, 0)
        self.others: dict[str, socket.socket] = {}
        self.random = np.random.default_rng(int.from_bytes(os.urandom(4), "little"))
        self.begin()

    def _socket(self, address: str, port: int) -> socket.socket:
        sock = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        sock.bind((address, port))
        sock.setblocking(False)
        if self.options.group is not None:
            sock.setsockopt(socket.IPPROTO_IP, socket.IP_MULTICAST_IF, socket.inet_aton(self.options.address))
        return sock

    def begin(self) -> None:
        self.clients: dict[tuple[str, int], float] = {}
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
        f, o = self.faults, self.options
        now = time.monotonic()
        if not f.stop:
            self.sequence += 0 if f.frozen_number else 1
            stamp = self.clock()
            ticks = (int((stamp - _EXPOSURE_TO_TRANSMIT) * TICK_RATE), int(stamp * TICK_RATE)) if o.ticks else (0, 0)
            bodies = self.bodies()
            data = layout.frame(o.version, self.sequence, bodies, stamp, *ticks, extras=o.extras)
            if f.foreign is not None:
                wrong = [replace(body, position=np.asarray(body.position) + 1.0) for body in bodies]
                frame = layout.frame(o.version, self.sequence + 1000, wrong, stamp, *ticks, extras=o.extras)
                self.send(frame, self.others.setdefault(f.foreign, self._socket(f.foreign, 0)))
            if f.truncate is not None:
                data = data[: f.truncate]
            for _ in range(f.garbage):
                self.send(self.random.bytes(int(self.random.integers(1, 400))), self.data)
            self.emit(data, now + f.delay)
        while self.queue and self.queue[0][0] <= time.monotonic():
            self.send(self.queue.pop(0)[1], self.data)

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

    def send(self, data: bytes, sock: socket.socket) -> None:
        now = time.monotonic()
        if self.options.group is not None:
            receivers = [(self.options.group, self.options.data_port)]
        else:
            receivers = [address for address, seen in self.clients.items() if now - seen < _CLIENT_LIFETIME]
        for receiver in receivers:
            sock.sendto(data, receiver)

    def answer(self) -> None:
        o = self.options
        while True:
            try:
                data, client = self.command.recvfrom(65535)
            except BlockingIOError:
                return
            if self.faults.mute:
                continue
            request = int.from_bytes(data[:2], "little")
            if request == layout.CONNECT or client in self.clients:
                self.clients[client] = time.monotonic()
            if request == layout.CONNECT:
                reply = layout.server_info(o.version, TICK_RATE if o.ticks else 0, data_port=o.data_port)
            elif request == layout.REQUEST_MODEL:
                reply = layout.model(o.version, o.names, o.extras)
            elif request == layout.KEEPALIVE:
                continue
            else:
                reply = layout.message(layout.UNRECOGNIZED, b"")
            self.command.sendto(reply, client)

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


def _serve(pipe: Connection, options: ServerOptions) -> None:
    """The process: until the other end of the pipe is closed."""
    server = _Server(pipe, options)
    pipe.send((server.command.getsockname()[1], server.options.data_port))
    due = time.monotonic()
    while True:
        waiting = max(0.0, due - time.monotonic())
        ready, _, _ = select.select([pipe, server.command], [], [], waiting)
        if pipe in ready:
            try:
                server.obey()
            except EOFError:
                return
        if server.command in ready:
            server.answer()
        if time.monotonic() >= due:
            server.tick()
            due = max(due + 1.0 / server.options.rate, time.monotonic() - 0.1)
