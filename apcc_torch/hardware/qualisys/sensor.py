"""`QualisysSensor`: poses of rigid bodies from QTM's real-time stream, in the arm's base frame, gated and stamped."""

from __future__ import annotations

from apcc_torch.hardware.mocap.sensor import MocapSensor
from apcc_torch.hardware.qualisys import packets
from apcc_torch.hardware.qualisys.link import Link
from apcc_torch.hardware.qualisys.settings import QualisysSettings

_TRY_AGAIN = 0.3  # s between two tries to connect
_PATIENCE = 2.0  # s for which a server that has accepted a connection may say nothing


class QualisysSensor(MocapSensor):
    """Motion capture by Qualisys; see `MocapSensor`.

    Stamps are those of the markers' measurement. When a frame was sent QTM does not tell, so the delay that even the
    fastest frame has, its computation and its way, is not in them: tell it as `latency`.

    Args:
        settings: Addresses, bodies, axes and limits.
        base: See `MocapSensor`, in QTM's world.
    """

    settings_type = QualisysSettings
    settings: QualisysSettings
    library = "qtm_rt"
    server_name = "QTM"

    def _forget(self) -> None:
        super()._forget()
        self._link = Link(self.settings, self._counts, self._take, self._tend)
        self._version: str | None = None  # as QTM has confirmed it
        self._asked: str | None = None  # the command whose answer is awaited
        self._named: list[tuple[str, int]] | None = None

    def _open(self) -> None:
        self._link.open()

    def _close(self) -> None:
        self._link.close()

    @property
    def _running(self) -> bool:
        return self._link.running

    @property
    def _where(self) -> str:
        return f"{self.settings.server}:{self.settings.port}"

    @property
    def _answers(self) -> bool:
        return self._version is not None

    @property
    def version(self) -> str | None:
        """Of the protocol, as QTM has confirmed it; None before that."""
        return self._version

    # From here on: called in the link's thread.

    def _take(self, kind: int, body: bytes, arrival: float) -> None:
        """Takes one of QTM's packets."""
        if kind == packets.DATA:
            # Before the names are known, or known again, a frame means nothing.
            if self._ids is not None and self._named is not None:
                frame = packets.read_frame(body, len(self._named))
                if frame is not None:
                    self._track(frame, packets.MICROSECONDS, arrival)
        elif kind == packets.COMMAND:
            self._answered(packets.text_of(body))
        elif kind == packets.XML:
            self._take_names(packets.read_bodies(body))
        elif kind == packets.ERROR:
            self._take_error(packets.text_of(body))
        elif kind == packets.EVENT:
            if body[:1] and body[0] in packets.CHANGED:
                self._ask("getparameters 6d")
        elif kind != packets.NO_MORE_DATA:
            self._counts.unexpected += 1

    def _answered(self, text: str) -> None:
        if text.startswith(packets.WELCOME):
            self._ask(f"version {packets.VERSION}")
        elif text.startswith(packets.VERSION_SET):
            self._version = text.removeprefix(packets.VERSION_SET).strip(" .")
            self._ask("getparameters 6d")

    def _take_error(self, text: str) -> None:
        if self._asked is not None and self._asked.startswith("version"):
            self._refuse(f"QTM does not speak version {packets.VERSION} of its protocol: {text}")
        else:
            self._log.warning("error", "QTM says: %s", text)

    def _take_names(self, named: list[tuple[str, int]]) -> None:
        if self._ids is None or named != self._named:
            self._named = named
            self._learn(named)
        self._ask("streamframes stop")
        port = f"UDP:{self._link.frames_port} " if self.settings.transport == "udp" else ""
        self._ask(f"streamframes allframes {port}6d")

    def _ask(self, command: str) -> None:
        self._asked = command
        self._link.send(command)

    def _lose(self, why: str) -> None:
        super()._lose(why)
        self._link.drop()

    def _tend(self, now: float) -> None:
        """Connects where there is no connection, and begins anew where one tells nothing."""
        self._mind_silence(now)
        if self._ids is not None and not self._link.connected:
            self._lose("the connection was closed")
        if self._ids is None and now >= self._next_request:
            self._link.drop()
            self._asked = None
            self._link.connect()
            self._next_request = now + (_PATIENCE if self._link.connected else _TRY_AGAIN)
