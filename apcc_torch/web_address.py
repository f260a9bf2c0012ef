"""Where a page is served: an address of this machine and a port, on the loopback unless told otherwise."""

from __future__ import annotations

import socket
from dataclasses import dataclass
from typing import ClassVar, Self

from apcc_torch.errors import ConfigError, in_a_line
from apcc_torch.settings import OURS, Settings, setting

LOOPBACK = "127.0.0.1"
EVERYWHERE = ("0.0.0.0", "::")
"""Hosts that stand for all addresses of the machine."""


@dataclass(frozen=True, kw_only=True)
class WebAddress(Settings):
    """Where a page is served.

    Example:
        >>> WebAddress(port=8090).url
        'http://127.0.0.1:8090'
    """

    scheme: ClassVar[str] = "http"
    group: ClassVar[str] = "page."

    host: str = setting(
        LOOPBACK, "", OURS, "address that it is served on; 0.0.0.0: to everyone who reaches this machine"
    )
    port: int = setting(8080, "", OURS, "port of the page; 0: any that is free", least=0, most=65535)

    @property
    def url(self) -> str:
        """What to open on this machine."""
        return f"{self.scheme}://{'localhost' if self.host in EVERYWHERE else self.host}:{self.port}"

    def free(self, prefix: str | None = None) -> Self:
        """The address with a port that nothing listens on: its own, or any where it is 0.

        Args:
            prefix: What stands before the settings' names where they were given, for the sentence; None: their group.

        Raises:
            ConfigError: The port is taken, or the host is no address of this machine.
        """
        prefix = self.group if prefix is None else prefix
        try:
            family = socket.getaddrinfo(self.host, self.port, type=socket.SOCK_STREAM)[0][0]
        except OSError as error:
            raise ConfigError(f"{prefix}host={self.host} is no address: {in_a_line(error)}") from error
        with socket.socket(family, socket.SOCK_STREAM) as probe:
            probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            try:
                probe.bind((self.host, self.port))
            except OSError as error:
                raise ConfigError(
                    f"{prefix}port={self.port} of {self.host} cannot be had ({in_a_line(error)}): choose another one, "
                    "or 0 for any that is free"
                ) from error
            return self.changed(port=probe.getsockname()[1])


@dataclass(frozen=True, kw_only=True)
class StreamAddress(WebAddress):
    """Where a stream is served to Foxglove; its port is the one that Foxglove proposes.

    Example:
        >>> StreamAddress().url
        'ws://127.0.0.1:8765'
    """

    scheme: ClassVar[str] = "ws"
    group: ClassVar[str] = "stream."

    port: int = setting(8765, "", OURS, "port of the stream; 0: any that is free", least=0, most=65535)
