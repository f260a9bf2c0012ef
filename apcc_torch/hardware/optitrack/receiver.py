"""The sockets and the thread that empties them: only the server is heard, and no datagram can end the thread."""

from __future__ import annotations

import selectors
import socket
import threading
import time
from collections.abc import Callable
from functools import partial

from apcc_torch.errors import CommunicationError
from apcc_torch.hardware.mocap.counts import Counts
from apcc_torch.hardware.mocap.handling import foreign, guarded
from apcc_torch.hardware.mocap.limited_log import LimitedLog
from apcc_torch.hardware.optitrack.packets import MAX_DATAGRAM
from apcc_torch.hardware.optitrack.settings import OptiTrackSettings
from apcc_torch.plain_text import plain_logger

_TEND = 0.05  # s between two calls of `tend` at most
_BATCH = 64  # datagrams taken from a socket before `tend` gets its turn
# Linux: without this set to 0, a socket also hears its group on interfaces that other programs joined it on.
_IP_MULTICAST_ALL = 49

log = plain_logger(__name__)


def _udp_socket() -> socket.socket:
    sock = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    sock.setblocking(False)
    return sock


class Receiver:
    """Receives datagrams of one server on one interface in a thread of its own.

    Args:
        settings: Addresses and ports.
        counts: What came and what was dropped.
        take: Called in the thread with each of the server's datagrams and its monotonic arrival in s. It may raise.
        tend: Called in the thread with the monotonic time in s, some twenty times a second or more often.
    """

    def __init__(
        self,
        settings: OptiTrackSettings,
        counts: Counts,
        take: Callable[[bytes, float], None],
        tend: Callable[[float], None],
    ) -> None:
        self._settings, self._counts, self._take, self._tend = settings, counts, take, tend
        self._log = LimitedLog(log)
        self._sockets: list[socket.socket] = []
        self._wake: tuple[socket.socket, socket.socket] | None = None
        self._thread: threading.Thread | None = None
        self._stop = threading.Event()

    def open(self) -> None:
        """Opens the sockets and starts the thread.

        Raises:
            CommunicationError: A socket cannot be opened.
        """
        s = self._settings
        try:
            command = _udp_socket()
            self._sockets.append(command)
            command.bind((s.interface, 0))
            if s.multicast:
                self._join_group()
        except OSError as error:
            self.close()
            raise CommunicationError(f"cannot listen on interface {s.interface}: {error.strerror}") from error
        self._wake = socket.socketpair()
        self._stop.clear()
        self._thread = threading.Thread(target=self._run, args=self._wake[:1], name="optitrack", daemon=True)
        self._thread.start()

    def close(self) -> None:
        """Ends the thread and closes the sockets. Safe to call in any state."""
        self._stop.set()
        if self._thread is not None and self._wake is not None:
            self._wake[1].send(b"\0")
            self._thread.join()
        for sock in (*self._sockets, *(self._wake or ())):
            sock.close()
        self._sockets, self._wake, self._thread = [], None, None

    def send(self, datagram: bytes) -> None:
        """Sends to the server's command port; a failure is counted, for the next try is never far."""
        try:
            self._sockets[0].sendto(datagram, (self._settings.server, self._settings.command_port))
        except OSError as error:
            self._counts.socket_errors += 1
            self._log.warning("send", "cannot reach %s: %s", self._settings.server, error)

    @property
    def addresses(self) -> list[tuple[str, int]]:
        """What is listened on."""
        return [sock.getsockname() for sock in self._sockets]

    @property
    def running(self) -> bool:
        """Whether the thread lives."""
        return self._thread is not None and self._thread.is_alive()

    def _join_group(self) -> None:
        s = self._settings
        sock = _udp_socket()
        self._sockets.append(sock)
        sock.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        sock.bind((s.group, s.data_port))  # the group's address, not all addresses: nothing sent to us alone comes in
        member = socket.inet_aton(s.group) + socket.inet_aton(s.interface)
        sock.setsockopt(socket.IPPROTO_IP, socket.IP_ADD_MEMBERSHIP, member)
        sock.setsockopt(socket.IPPROTO_IP, _IP_MULTICAST_ALL, 0)

    def _run(self, woken: socket.socket) -> None:
        with selectors.DefaultSelector() as selector:
            selector.register(woken, selectors.EVENT_READ)
            for sock in self._sockets:
                selector.register(sock, selectors.EVENT_READ, data=sock)
            while not self._stop.is_set():
                for key, _ in selector.select(_TEND):
                    if key.data is not None:
                        self._empty(key.data)
                self._guarded(partial(self._tend, time.monotonic()))

    def _empty(self, sock: socket.socket) -> None:
        for _ in range(_BATCH):
            try:
                data, sender = sock.recvfrom(MAX_DATAGRAM)
            except BlockingIOError:
                return
            except OSError as error:
                self._counts.socket_errors += 1
                self._log.warning("receive", "cannot receive: %s", error)
                self._stop.wait(_TEND)  # an error that stays must not spin
                return
            arrival = time.monotonic()
            if foreign(sender[0], self._settings.server, self._counts, self._log):
                continue
            self._guarded(partial(self._take, data, arrival))

    def _guarded(self, call: Callable[[], None]) -> None:
        guarded(call, self._counts, self._log)
