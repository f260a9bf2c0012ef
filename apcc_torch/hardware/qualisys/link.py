"""The connection to QTM and the thread that empties it: only the server is heard, and no packet can end the thread."""

from __future__ import annotations

import selectors
import socket
import threading
import time
from collections import deque
from collections.abc import Callable
from functools import partial

from apcc_torch.errors import CommunicationError
from apcc_torch.hardware.mocap.counts import Counts
from apcc_torch.hardware.mocap.handling import foreign, guarded
from apcc_torch.hardware.mocap.limited_log import LimitedLog
from apcc_torch.hardware.qualisys import packets
from apcc_torch.hardware.qualisys.settings import QualisysSettings
from apcc_torch.plain_text import plain_logger

_TEND = 0.05  # s between two calls of `tend` at most
_BATCH = 64  # datagrams or segments taken from a socket before `tend` gets its turn
_NEWEST = 8  # of those that are waiting, how many frames are looked at
_PATIENCE = 0.5  # s that the server may take to accept a connection, or to take a command
_SEGMENT = 65536

log = plain_logger(__name__)


class Link:
    """A TCP connection for commands, a UDP socket for frames, and one thread for both.

    Args:
        settings: Addresses and ports.
        counts: What came and what was dropped.
        take: Called in the thread with type, body and monotonic arrival, s, of each of the server's packets; may raise.
        tend: Called in the thread with the monotonic time in s, some twenty times a second or more often.
    """

    def __init__(
        self,
        settings: QualisysSettings,
        counts: Counts,
        take: Callable[[int, bytes, float], None],
        tend: Callable[[float], None],
    ) -> None:
        self._settings, self._counts, self._take, self._tend = settings, counts, take, tend
        self._log = LimitedLog(log)
        self._selector: selectors.BaseSelector | None = None
        self._commands: socket.socket | None = None
        self._frames: socket.socket | None = None
        self._rest = b""  # of the stream, not yet a whole packet
        self._wake: tuple[socket.socket, socket.socket] | None = None
        self._thread: threading.Thread | None = None
        self._stop = threading.Event()

    def open(self) -> None:
        """Opens the socket for frames and starts the thread, which connects by itself.

        Raises:
            CommunicationError: It cannot be opened.
        """
        frames = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        try:
            frames.setblocking(False)
            frames.bind((self._settings.interface, 0))
        except OSError as error:
            frames.close()
            raise CommunicationError(
                f"cannot listen on interface {self._settings.interface}: {error.strerror}"
            ) from error
        self._frames, self._wake = frames, socket.socketpair()
        self._stop.clear()
        self._thread = threading.Thread(target=self._run, args=(frames, self._wake[0]), name="qualisys", daemon=True)
        self._thread.start()

    def close(self) -> None:
        """Ends the thread and closes the sockets. Safe to call in any state."""
        self._stop.set()
        if self._thread is not None and self._wake is not None:
            self._wake[1].send(b"\0")
            self._thread.join()
        for sock in (self._commands, self._frames, *(self._wake or ())):
            if sock is not None:
                sock.close()
        self._commands, self._frames, self._wake, self._thread = None, None, None, None

    @property
    def running(self) -> bool:
        """Whether the thread lives."""
        return self._thread is not None and self._thread.is_alive()

    @property
    def connected(self) -> bool:
        """Whether there is a connection for commands."""
        return self._commands is not None

    @property
    def frames_port(self) -> int:
        """Where frames are to be sent."""
        return 0 if self._frames is None else int(self._frames.getsockname()[1])

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
            self._failed("send", f"cannot send to {self._settings.server}: {error}")
            self.drop()

    def _failed(self, kind: str, why: str) -> None:
        self._counts.socket_errors += 1
        self._log.warning(kind, "%s", why)

    def _run(self, frames: socket.socket, woken: socket.socket) -> None:
        with selectors.DefaultSelector() as selector:
            self._selector = selector
            selector.register(woken, selectors.EVENT_READ)
            selector.register(frames, selectors.EVENT_READ, data=partial(self._empty, frames))
            while not self._stop.is_set():
                for key, _ in selector.select(_TEND):
                    if key.data is not None and not self._stop.is_set():
                        self._guarded(key.data)
                self._guarded(partial(self._tend, time.monotonic()))
        self._selector = None

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

    def _empty(self, frames: socket.socket) -> None:
        """Takes the datagrams that have come, of many the newest: a thread that lags behind must not stay behind."""
        waiting: deque[tuple[bytes, float]] = deque(maxlen=_NEWEST)
        for _ in range(_BATCH):
            try:
                data, sender = frames.recvfrom(_SEGMENT)
            except BlockingIOError:
                break
            except OSError as error:
                self._failed("receive", f"cannot receive: {error}")
                self._stop.wait(_TEND)  # an error that stays must not spin
                break
            if foreign(sender[0], self._settings.server, self._counts, self._log):
                continue
            self._counts.skipped += len(waiting) == _NEWEST
            waiting.append((data, time.monotonic()))
        for data, arrival in waiting:
            self._guarded(partial(self._datagram, data, arrival))

    def _datagram(self, data: bytes, arrival: float) -> None:
        self._take(*packets.open_datagram(data), arrival)

    def _guarded(self, call: Callable[[], None]) -> None:
        guarded(call, self._counts, self._log)
