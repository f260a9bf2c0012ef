"""The connection to QTM and the thread that empties it: only the server is heard, and no packet can end the thread."""

from __future__ import annotations

import selectors
import socket
import time
from collections import deque
from collections.abc import Callable
from functools import partial

from apcc_torch.errors import CommunicationError
from apcc_torch.hardware.mocap.counts import Counts
from apcc_torch.hardware.mocap.listener import Listener
from apcc_torch.hardware.qualisys import packets
from apcc_torch.hardware.qualisys.settings import QualisysSettings
from apcc_torch.plain_text import plain_logger

_NEWEST = 8  # of those that are waiting, how many frames are looked at
_PATIENCE = 0.5  # s that the server may take to accept a connection, or to take a command
_SEGMENT = 65536

log = plain_logger(__name__)


class Link(Listener):
    """A TCP connection for commands, a UDP socket for frames, and one thread for both.

    Args:
        settings: Addresses and ports.
        counts: What came and what was dropped.
        take: Called in the thread with type, body and monotonic arrival, s, of each of the server's packets; may raise.
        tend: See `Listener`.
    """

    def __init__(
        self,
        settings: QualisysSettings,
        counts: Counts,
        take: Callable[[int, bytes, float], None],
        tend: Callable[[float], None],
    ) -> None:
        super().__init__(settings.server, settings.interface, counts, tend, log)
        self._settings, self._take = settings, take
        self._commands: socket.socket | None = None
        self._rest = b""  # of the stream, not yet a whole packet

    def _listen(self) -> None:
        """The socket for frames; the thread connects the one for commands by itself."""
        self._udp_socket().bind((self._interface, 0))

    def close(self) -> None:
        """See `Listener.close`."""
        super().close()
        self.drop()

    @property
    def connected(self) -> bool:
        """Whether there is a connection for commands."""
        return self._commands is not None

    @property
    def frames_port(self) -> int:
        """Where frames are to be sent."""
        return self.addresses[0][1] if self._sockets else 0

    # From here on: called in the thread.

    def connect(self) -> None:
        """Opens the connection for commands; a failure is counted, for the next try is never far."""
        s, sock = self._settings, socket.socket(socket.AF_INET, socket.SOCK_STREAM)
        try:
            sock.settimeout(_PATIENCE)
            sock.bind((s.interface, 0))
            sock.connect((s.server, s.port))
            sock.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        except OSError as error:
            sock.close()
            self._failed("connect", f"cannot reach {s.server}:{s.port}: {error}")
            return
        self._commands, self._rest = sock, b""
        if self._selector is not None:
            self._selector.register(sock, selectors.EVENT_READ, data=self._read)

    def drop(self) -> None:
        """Closes the connection for commands."""
        sock, self._commands, self._rest = self._commands, None, b""
        if sock is not None:
            if self._selector is not None:
                self._selector.unregister(sock)
            sock.close()

    def send(self, command: str) -> None:
        """Sends a command; where that fails the connection is dropped."""
        if self._commands is None:
            return
        try:
            self._commands.sendall(packets.command(command))
        except OSError as error:
            self._failed("send", f"cannot send to {self._server}: {error}")
            self.drop()

    def _read(self) -> None:
        """Takes what the connection has brought."""
        if self._commands is None:
            return
        try:
            data = self._commands.recv(_SEGMENT)
        except OSError as error:
            self._failed("receive", f"cannot receive: {error}")
            data = b""
        if not data:
            self.drop()
            return
        arrival = time.monotonic()
        try:
            whole, self._rest = packets.split(self._rest + data)
        except CommunicationError:
            self.drop()  # where the next packet begins nobody knows
            raise
        self._counts.packets += len(whole)
        late = [k for k, (kind, _) in enumerate(whole) if kind == packets.DATA][:-_NEWEST]
        self._counts.skipped += len(late)
        for k, (kind, body) in enumerate(whole):
            if k not in late:
                self._guarded(partial(self._take, kind, body, arrival))

    def _empty(self, sock: socket.socket) -> None:
        """Takes the datagrams that have come, of many the newest: a thread that lags behind must not stay behind."""
        waiting: deque[tuple[bytes, float]] = deque(maxlen=_NEWEST)
        for datagram in self._received(sock):
            self._counts.skipped += len(waiting) == _NEWEST
            waiting.append(datagram)
        for data, arrival in waiting:
            self._guarded(partial(self._datagram, data, arrival))

    def _datagram(self, data: bytes, arrival: float) -> None:
        self._take(*packets.open_datagram(data), arrival)
