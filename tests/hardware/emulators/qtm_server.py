"""QTM's real-time server in a process of its own, on loopback: version handshake, parameters as XML, frames over UDP or
TCP, written from the protocol, with faults on demand.

    with QtmServer(names={1: "base", 2: "disk_1"}, rate=100) as server:
        settings = QualisysSettings(base="base", bodies=("disk_1",), port=server.command_port)
        ...
        server.fault(untracked=[2])
"""

from __future__ import annotations

import socket
import struct
from multiprocessing.connection import Connection
from xml.sax.saxutils import escape

import numpy as np

from hardware.emulators.mocap_server import EXPOSURE_TO_TRANSMIT, Body, MocapServer, Server, ServerOptions

ERROR, COMMAND, XML, DATA, NO_MORE_DATA, EVENT = 0, 1, 2, 3, 4, 6
TIMECODE, COMPONENT_6D = 17, 5
SETTINGS_CHANGED = 11


def packet(kind: int, body: bytes) -> bytes:
    return struct.pack("<II", 8 + len(body), kind) + body


def text(kind: int, words: str) -> bytes:
    return packet(kind, words.encode() + b"\0")


def parameters(names: list[str], version: str) -> str:
    """The 6D settings as QTM 2024 has them."""
    bodies = "".join(
        f"<Body><Name>{escape(name)}</Name><Enabled>true</Enabled><Color R='0' G='255' B='0'/>"
        f"<MaximumResidual>10</MaximumResidual><MinimumMarkersInBody>3</MinimumMarkersInBody></Body>"
        for name in names
    )
    root = f"QTM_Parameters_Ver_{version}"
    return f"<{root}><The_6D>{bodies}<Euler><First>Roll</First></Euler></The_6D></{root}>"


def frame(sequence: int, bodies: list[Body | None], microseconds: int, extras: bool) -> bytes:
    """A data packet with all bodies in their order; None and an untracked one are NaN, lengths are mm."""
    rows = []
    for body in bodies:
        if body is None or not body.tracked:
            rows.append(np.full(12, np.nan, dtype="<f4"))
            continue
        x, y, z, w = body.quaternion
        axes = (  # what the body's x, y and z axes are in the world
            (x * x - y * y - z * z + w * w, 2 * (x * y + z * w), 2 * (x * z - y * w)),
            (2 * (x * y - z * w), y * y - x * x - z * z + w * w, 2 * (y * z + x * w)),
            (2 * (x * z + y * w), 2 * (y * z - x * w), z * z - x * x - y * y + w * w),
        )
        rows.append(np.concatenate((1e3 * np.asarray(body.position), *axes)).astype("<f4"))
    six = struct.pack("<ihh", len(bodies), 0, 0) + b"".join(row.tobytes() for row in rows)
    components = [(TIMECODE, struct.pack("<iiII", 1, 0, 7, 9))] if extras else []
    components.append((COMPONENT_6D, six))
    body = b"".join(struct.pack("<II", 8 + len(data), kind) + data for kind, data in components)
    return packet(DATA, struct.pack("<qII", microseconds, sequence & 0xFFFFFFFF, len(components)) + body)


class _Server(Server):
    def __init__(self, pipe: Connection, options: ServerOptions) -> None:
        self.options = options
        self.listener = socket.create_server((options.address, 0))
        self.listener.setblocking(False)
        self.clients: list[socket.socket] = []
        self.data = self._socket(options.address)
        super().__init__(pipe, options)

    def _socket(self, address: str) -> socket.socket:
        sock = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        sock.bind((address, 0))
        return sock

    @property
    def sockets(self) -> list[socket.socket]:
        return [self.listener, *self.clients]

    @property
    def ports(self) -> tuple[int, int]:
        return self.listener.getsockname()[1], 0

    def begin(self) -> None:
        super().begin()
        for client in self.clients:
            client.close()
        self.clients = []
        self.streams: dict[socket.socket, tuple[str, int] | None] = {}  # to where; None: over the connection
        self.unread: dict[socket.socket, bytes] = {}

    def encoded(self, sequence: int, bodies: list[Body], stamp: float) -> bytes:
        by_number = {body.number: body for body in bodies}
        ordered = [by_number.get(number) for number in self.options.names]
        return frame(sequence, ordered, int(1e6 * (stamp - EXPOSURE_TO_TRANSMIT)), self.options.extras)

    def send(self, data: bytes, foreign: str | None = None) -> None:
        sock = self.data if foreign is None else self.others.setdefault(foreign, self._socket(foreign))
        for client, address in list(self.streams.items()):
            try:
                if address is not None:
                    sock.sendto(data, address)
                elif foreign is None:
                    client.sendall(data)
            except OSError:
                self.leave(client)

    def leave(self, client: socket.socket) -> None:
        if client in self.clients:
            self.clients.remove(client)
        self.streams.pop(client, None)
        self.unread.pop(client, None)
        client.close()

    def answer(self) -> None:
        try:
            client, _ = self.listener.accept()
            client.setblocking(False)
            self.clients.append(client)
            self.unread[client] = b""
            self.tell(client, text(COMMAND, "QTM RT Interface connected"))
        except BlockingIOError:
            pass
        for client in list(self.clients):
            try:
                data = client.recv(65536)
            except BlockingIOError:
                continue
            except OSError:
                data = b""
            if not data:
                self.leave(client)
                continue
            data = self.unread[client] + data
            while len(data) >= 8 and len(data) >= (size := struct.unpack_from("<I", data)[0]):
                self.obey_command(client, data[8:size].rstrip(b"\0").decode())
                data = data[size:]
            self.unread[client] = data

    def tell(self, client: socket.socket, data: bytes) -> None:
        if self.faults.mute:
            return
        try:
            client.sendall(data)
        except OSError:
            self.leave(client)

    def obey_command(self, client: socket.socket, command: str) -> None:
        """What QTM says to a command; one that it does not know is an error."""
        name, _, rest = command.partition(" ")
        highest = self.options.version
        if name == "version":
            asked = tuple(int(part) for part in rest.split("."))
            if highest[0] != asked[0] or asked > highest:
                self.tell(client, text(ERROR, "Version NOT supported"))
            else:
                self.tell(client, text(COMMAND, f"Version set to {rest}"))
        elif name == "getparameters" and rest.lower() == "6d":
            self.tell(client, text(XML, parameters(list(self.options.names.values()), "1.25")))
        elif name == "streamframes" and rest == "stop":
            self.streams.pop(client, None)
        elif name == "streamframes":
            words = rest.split()
            udp = [word for word in words if word.startswith("UDP:")]
            self.streams[client] = (client.getpeername()[0], int(udp[0][4:])) if udp else None
        else:
            self.tell(client, text(ERROR, f"Unknown command {name!r}"))


def _serve(pipe: Connection, options: ServerOptions) -> None:
    _Server(pipe, options).serve()


class QtmServer(MocapServer):
    """QTM, as far as a client can tell; `version` is the highest that it speaks."""

    process = staticmethod(_serve)
    version = (1, 27)
