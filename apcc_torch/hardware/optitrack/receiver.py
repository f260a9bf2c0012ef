"""The sockets that datagrams of a NatNet server come to."""

from __future__ import annotations

import socket
from collections.abc import Callable
from functools import partial

from apcc_torch.hardware.mocap.counts import Counts
from apcc_torch.hardware.mocap.listener import Listener
from apcc_torch.hardware.optitrack.settings import OptiTrackSettings
from apcc_torch.plain_text import plain_logger

# Linux: without this set to 0, a socket also hears its group on interfaces that other programs joined it on.
_IP_MULTICAST_ALL = 49

log = plain_logger(__name__)


class Receiver(Listener):
    """Receives datagrams of one server on one interface in a thread of its own.

    Args:
        settings: Addresses and ports.
        counts: What came and what was dropped.
        take: Called in the thread with each of the server's datagrams and its monotonic arrival in s. It may raise.
        tend: See `Listener`.
    """

    def __init__(
        self,
        settings: OptiTrackSettings,
        counts: Counts,
        take: Callable[[bytes, float], None],
        tend: Callable[[float], None],
    ) -> None:
        super().__init__(settings.server, settings.interface, counts, tend, log)
        self._settings, self._take = settings, take

    def send(self, datagram: bytes) -> None:
        """Sends to the server's command port; a failure is counted, for the next try is never far."""
        try:
            self._sockets[0].sendto(datagram, (self._server, self._settings.command_port))
        except OSError as error:
            self._failed("send", f"cannot reach {self._server}: {error}")

    def _listen(self) -> None:
        s, command = self._settings, self._udp_socket()
        command.bind((s.interface, 0))
        if not s.multicast:
            return
        sock = self._udp_socket()
        sock.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        sock.bind((s.group, s.data_port))  # the group's address, not all addresses: nothing sent to us alone comes in
        member = socket.inet_aton(s.group) + socket.inet_aton(s.interface)
        sock.setsockopt(socket.IPPROTO_IP, socket.IP_ADD_MEMBERSHIP, member)
        sock.setsockopt(socket.IPPROTO_IP, _IP_MULTICAST_ALL, 0)

    def _empty(self, sock: socket.socket) -> None:
        for data, arrival in self._received(sock):
            self._guarded(partial(self._take, data, arrival))
