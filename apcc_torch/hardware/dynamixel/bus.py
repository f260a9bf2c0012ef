"""The Dynamixel bus: protocol 2.0 as the SDK packs it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from apcc_torch.errors import CommunicationError, DeviceFaultError
from apcc_torch.hardware.servos.bus import SUCCESS, ServoBus
from apcc_torch.hardware.servos.port import BusPort
from apcc_torch.hardware.servos.register import Register

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

    bauds = (9_600, 57_600, 115_200, 1_000_000, 2_000_000, 3_000_000, 4_000_000, 4_500_000)

    def __init__(self, port: BusPort, names: Mapping[int, str]) -> None:
        super().__init__(port, names)
        self.packets = PacketHandler()

    def _check_error(self, motor: int, error: int) -> None:
        code = error & ~ALERT_BIT
        if code == CHECKSUM_ERROR:
            raise CommunicationError(f"{self.name(motor)} received a corrupt packet")
        if code:
            raise DeviceFaultError(f"{self.name(motor)} {ERRORS.get(code, f'answers with error {code}')}")

    def _timed_out(self, result: int) -> bool:
        return bool(result == COMM_RX_TIMEOUT)

    def _receive(self) -> tuple[Sequence[int], int]:
        packet, result = self.packets.rxPacket(self.port, False)
        return packet, result

    def _sender(self, packet: Sequence[int]) -> int:
        return packet[ID]

    def _data(self, motor: int, packet: Sequence[int], length: int) -> bytes:
        self._check_error(motor, packet[ERROR])
        sent = packet[LENGTH] + 256 * packet[LENGTH + 1] - LENGTH_WITHOUT_DATA
        if sent != length:
            raise CommunicationError(f"{self.name(motor)}: reply with {sent} bytes of data instead of {length}")
        return bytes(packet[DATA : DATA + length])

    def _ask(self, motors: Sequence[int], address: int, length: int) -> None:
        if len(motors) == 1:
            self._check(motors[0], self.packets.readTx(self.port, motors[0], address, length))
            return
        result = self.packets.syncReadTx(self.port, address, length, list(motors), len(motors), False)
        if result != SUCCESS:
            raise CommunicationError(f"sync read: {self.packets.getTxRxResult(result)}")

    def ping(self, motor: int) -> None:
        """See `ServoBus.ping`."""
        self._begin()
        _, result, error = self.packets.ping(self.port, motor)
        self._check(motor, result)
        self._check_error(motor, error)

    def write_bytes(self, motor: int, address: int, data: bytes) -> None:
        """See `ServoBus.write_bytes`."""
        self._begin()
        result, error = self.packets.writeTxRx(self.port, motor, address, len(data), list(data))
        self._check(motor, result)
        self._check_error(motor, error)

    def sync_write(self, register: Register, values: Mapping[int, int]) -> None:
        """See `ServoBus.sync_write`."""
        self._begin()
        parameters = [byte for motor, value in values.items() for byte in (motor, *register.encode(value))]
        result = self.packets.syncWriteTxOnly(self.port, register.address, register.length, parameters, len(parameters))
        if result != SUCCESS:
            raise CommunicationError(f"sync write of {register.name}: {self.packets.getTxRxResult(result)}")
