"""The Dynamixel bus: protocol 2.0 as the SDK packs it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from apcc_torch.errors import CommunicationError, DeviceFaultError
from apcc_torch.hardware.servos.bus import ServoBus
from apcc_torch.hardware.servos.port import BusPort

try:
    from dynamixel_sdk import COMM_RX_TIMEOUT, Protocol2PacketHandler
except ModuleNotFoundError:  # the settings can be read all the same; who builds the driver is told
    Protocol2PacketHandler = object

# Places in a status packet: header (4), id, length (2), instruction, error, data, checksum (2).
ID, LENGTH, ERROR, DATA = 4, 5, 8, 9
LENGTH_WITHOUT_DATA = 4  # the length field counts instruction, error and checksum too

ALERT_BIT = 0x80  # a hardware error is latched; the status block tells which
CHECKSUM_ERROR = 3
ERRORS = {
    1: "could not do it",
    2: "does not know the instruction",
    4: "says the value is out of range",
    5: "says the data has the wrong length",
    6: "says the value exceeds a limit",
    7: "says the address cannot be read or written now",
}


class PacketHandler(Protocol2PacketHandler):
    """The SDK's packets, with their stuffing sent."""

    def addStuffing(self, packet: list[int]) -> list[int]:
        """Breaks up the header's bytes where data holds them. The SDK drops the result, so it goes into `packet`."""
        packet[:] = super().addStuffing(packet)
        return packet


class DynamixelBus(ServoBus):
    """Dynamixel motors on one port.

    After a failed read the SDK's own group reads return 0, and of a reply that is too short it returns the checksum as
    data: only its packets are used.

    Args:
        port: The port, opened by `open`.
        names: What messages call each id.
    """

    sender, data = ID, DATA
    bauds = (9_600, 57_600, 115_200, 1_000_000, 2_000_000, 3_000_000, 4_000_000, 4_500_000)

    def __init__(self, port: BusPort, names: Mapping[int, str]) -> None:
        super().__init__(port, names, PacketHandler(), COMM_RX_TIMEOUT, first=(port,), last=(False,))

    def _check_error(self, motor: int, error: int) -> None:
        code = error & ~ALERT_BIT
        if code == CHECKSUM_ERROR:
            raise CommunicationError(f"{self.name(motor)} received a corrupt packet")
        if code:
            raise DeviceFaultError(f"{self.name(motor)} {ERRORS.get(code, f'answers with error {code}')}")

    def _data(self, motor: int, packet: Sequence[int], length: int) -> bytes:
        self._check_error(motor, packet[ERROR])
        sent = packet[LENGTH] + 256 * packet[LENGTH + 1] - LENGTH_WITHOUT_DATA
        return self._cut(motor, packet, sent, length)

    def ping(self, motor: int) -> None:
        """See `ServoBus.ping`."""
        self._begin()
        _, result, error = self.packets.ping(self.port, motor)
        self._check(motor, result)
        self._check_error(motor, error)
