"""`OptiTrackSensor`: poses of rigid bodies from a NatNet stream, in the arm's base frame, gated and time-stamped."""

from __future__ import annotations

from apcc_torch.errors import HardwareError
from apcc_torch.hardware.mocap.sensor import MocapSensor
from apcc_torch.hardware.optitrack import packets
from apcc_torch.hardware.optitrack.receiver import Receiver
from apcc_torch.hardware.optitrack.settings import OptiTrackSettings

_ASK_AGAIN = 0.2  # s between two requests that the server has not answered


class OptiTrackSensor(MocapSensor):
    """Motion capture by OptiTrack; see `MocapSensor`.

    Stamps are those of the middle of the exposure where the server tells it, else of the server's software stamp.

    Args:
        settings: Addresses, bodies, axes and limits.
        base: See `MocapSensor`, in Motive's world.
    """

    settings_type = OptiTrackSettings
    settings: OptiTrackSettings
    library = "natnet"
    server_name = "NatNet server"

    def _forget(self) -> None:
        super()._forget()
        self._receiver = Receiver(self.settings, self._counts, self._take, self._tend)
        self._server: packets.Server | None = None
        self._greeted = False  # whether the server's version is known, and known to be a good one
        self._next_keepalive = 0.0

    def _open(self) -> None:
        self._receiver.open()

    def _close(self) -> None:
        self._receiver.close()

    @property
    def _running(self) -> bool:
        return self._receiver.running

    @property
    def _where(self) -> str:
        return f"{self.settings.server}:{self.settings.command_port}"

    @property
    def _answers(self) -> bool:
        return self._server is not None

    @property
    def server(self) -> packets.Server | None:
        """What the server says of itself; None before it has answered."""
        return self._server

    @property
    def addresses(self) -> list[tuple[str, int]]:
        """What is listened on: address and port of each socket."""
        return self._receiver.addresses

    # From here on: called in the receiver's thread.

    def _take(self, data: bytes, arrival: float) -> None:
        """Takes one of the server's datagrams."""
        message, buffer = packets.open_datagram(data)
        if message == packets.FRAME:
            # Before the server's names and version are known, or known again, a frame means nothing.
            if self._server is not None and self._ids is not None:
                self._track(packets.read_frame(buffer, self._server.version), self._server.tick_rate, arrival)
        elif message == packets.SERVER_INFO:
            self._greet(packets.read_server(buffer))
        elif message == packets.MODEL and self._server is not None:
            self._learn(packets.read_body_ids(buffer, self._server.version, self.settings.names))
        else:
            self._counts.unexpected += 1

    def _greet(self, server: packets.Server) -> None:
        refusal = None
        try:
            packets.check_version(server)
        except HardwareError as error:
            refusal = str(error)
        with self._changed:
            self._server, self._ids, self._greeted = server, None, refusal is None
            # Only its names tell that a server is a good one again.
            self._refusal = refusal or self._refusal
            self._changed.notify_all()
        self._next_request = 0.0

    def _lose(self, why: str) -> None:
        super()._lose(why)
        self._greeted = False

    def _tend(self, now: float) -> None:
        """Asks for what is not known yet, and tells a unicast server that we are here."""
        self._mind_silence(now)
        if self._ids is None and now >= self._next_request:
            self._next_request = now + _ASK_AGAIN
            self._receiver.send(packets.request(packets.REQUEST_MODEL if self._greeted else packets.CONNECT))
        if not self.settings.multicast and now >= self._next_keepalive:
            self._next_keepalive = now + self.settings.keepalive
            self._receiver.send(packets.request(packets.KEEPALIVE))
