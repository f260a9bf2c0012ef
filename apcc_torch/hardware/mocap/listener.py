"""Sockets on one interface and the thread that empties them: one server is heard, and no packet ends the thread."""

from __future__ import annotations

import logging
import selectors
import socket
import threading
import time
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator
from functools import partial

from apcc_torch.errors import CommunicationError
from apcc_torch.hardware.mocap.counts import Counts
from apcc_torch.hardware.mocap.limited_log import LimitedLog

_TEND = 0.05  # s between two calls of `tend` at most
_BATCH = 64  # datagrams taken from a socket before `tend` gets its turn
_MAX_DATAGRAM = 65535


class Listener(ABC):
    """Hears one server. What is foreign, damaged or a bug is counted, told and dropped.

    Args:
        server: IPv4 address that packets have to come from.
        interface: IPv4 address that is listened on.
        counts: What came and what was dropped.
        tend: Called in the thread with the monotonic time in s, some twenty times a second or more often.
        log: Where warnings go.
    """

    def __init__(
        self, server: str, interface: str, counts: Counts, tend: Callable[[float], None], log: logging.Logger
    ) -> None:
        self._server, self._interface, self._counts, self._tend = server, interface, counts, tend
        self._log = LimitedLog(log)
        self._sockets: list[socket.socket] = []
        self._selector: selectors.BaseSelector | None = None
        self._wake: tuple[socket.socket, socket.socket] | None = None
        self._thread: threading.Thread | None = None
        self._stop = threading.Event()

    @abstractmethod
    def _listen(self) -> None:
        """Opens and binds the sockets, with `_udp_socket`; may raise an OSError."""

    @abstractmethod
    def _empty(self, sock: socket.socket) -> None:
        """Takes what has come to a socket."""

    def open(self) -> None:
        """Opens the sockets and starts the thread.

        Raises:
            CommunicationError: A socket cannot be opened.
        """
        try:
            self._listen()
        except OSError as error:
            self.close()
            raise CommunicationError(f"cannot listen on interface {self._interface}: {error.strerror}") from error
        self._wake = socket.socketpair()
        self._stop.clear()
        self._thread = threading.Thread(target=self._run, args=self._wake[:1], name=type(self).__name__, daemon=True)
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

    @property
    def running(self) -> bool:
        """Whether the thread lives."""
        return self._thread is not None and self._thread.is_alive()

    @property
    def addresses(self) -> list[tuple[str, int]]:
        """What is listened on."""
        return [sock.getsockname() for sock in self._sockets]

    def _udp_socket(self) -> socket.socket:
        sock = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._sockets.append(sock)
        sock.setblocking(False)
        return sock

    # From here on: called in the thread.

    def _run(self, woken: socket.socket) -> None:
        with selectors.DefaultSelector() as selector:
            self._selector = selector
            selector.register(woken, selectors.EVENT_READ)
            for sock in self._sockets:
                selector.register(sock, selectors.EVENT_READ, data=partial(self._empty, sock))
            while not self._stop.is_set():
                for key, _ in selector.select(_TEND):
                    if key.data is not None and not self._stop.is_set():
                        self._guarded(key.data)
                self._guarded(partial(self._tend, time.monotonic()))
        self._selector = None

    def _received(self, sock: socket.socket) -> Iterator[tuple[bytes, float]]:
        """The server's datagrams that have come to a socket, not too many at once, and their arrival, s."""
        for _ in range(_BATCH):
            try:
                data, sender = sock.recvfrom(_MAX_DATAGRAM)
            except BlockingIOError:
                return
            except OSError as error:
                self._failed("receive", f"cannot receive: {error}")
                self._stop.wait(_TEND)  # an error that stays must not spin
                return
            arrival = time.monotonic()
            self._counts.packets += 1
            if sender[0] == self._server:
                yield data, arrival
            else:
                self._counts.foreign += 1
                self._log.warning("foreign", "dropped a packet from %s, which is not the server", sender[0])

    def _failed(self, kind: str, why: str) -> None:
        """A failure of a socket is counted, for the next try is never far."""
        self._counts.socket_errors += 1
        self._log.warning(kind, "%s", why)

    def _guarded(self, call: Callable[[], None]) -> None:
        """Calls it; whatever it raises is counted and logged, and the thread goes on."""
        try:
            call()
        except CommunicationError as error:
            self._counts.malformed += 1
            self._log.warning("malformed", "dropped a packet: %s", error)
        except Exception:
            self._counts.failed += 1
            self._log.warning("failed", "the handling of a packet failed", trace=True)
