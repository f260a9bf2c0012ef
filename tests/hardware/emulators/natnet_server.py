"""A NatNet server in a process of its own, on loopback: Motive as far as a client can tell, with faults on demand.

with NatNetServer(names={1: "base", 2: "disk_1"}, rate=100) as server:
    settings = OptiTrackSettings(base="base", bodies=("disk_1",), command_port=server.command_port)
    ...
    server.fault(untracked=[2])
"""

from __future__ import annotations

import socket
import time
from multiprocessing.connection import Connection

from hardware.emulators import natnet_layout as layout
from hardware.emulators.mocap_server import EXPOSURE_TO_TRANSMIT, Body, MocapServer, Server, ServerOptions
from hardware.emulators.natnet_layout import TICK_RATE

_CLIENT_LIFETIME = 3.0  # s without a word from a client


class _Server(Server):
    def __init__(self, pipe: Connection, options: ServerOptions) -> None:
        self.options = options
        self.command = self._socket(options.address, 0)
        self.data = self._socket(options.address, 0)
        super().__init__(pipe, options)

    def _socket(self, address: str, port: int) -> socket.socket:
        sock = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        sock.bind((address, port))
        sock.setblocking(False)
        if self.options.group is not None:
            sock.setsockopt(socket.IPPROTO_IP, socket.IP_MULTICAST_IF, socket.inet_aton(self.options.address))
        return sock

    @property
    def sockets(self) -> list[socket.socket]:
        return [self.command]

    @property
    def ports(self) -> tuple[int, int]:
        return self.command.getsockname()[1], self.options.data_port

    def begin(self) -> None:
        super().begin()
        self.clients: dict[tuple[str, int], float] = {}

    def encoded(self, sequence: int, bodies: list[Body], stamp: float) -> bytes:
        o = self.options
        ticks = (int((stamp - EXPOSURE_TO_TRANSMIT) * TICK_RATE), int(stamp * TICK_RATE)) if o.ticks else (0, 0)
        return layout.frame(o.version, sequence, bodies, stamp, *ticks, extras=o.extras)

    def send(self, data: bytes, foreign: str | None = None) -> None:
        now = time.monotonic()
        sock = self.data if foreign is None else self.others.setdefault(foreign, self._socket(foreign, 0))
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


def _serve(pipe: Connection, options: ServerOptions) -> None:
    _Server(pipe, options).serve()


class NatNetServer(MocapServer):
    """Motive, as far as a client can tell."""

    process = staticmethod(_serve)
