"""The Feetech bus: its protocol as the SDK packs it, half-duplex on one wire."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from apcc_torch.errors import CommunicationError, ValueRangeError
from apcc_torch.hardware.feetech.registers import MODEL_NUMBER, OFF, ON, TORQUE_SWITCH
from apcc_torch.hardware.servos.bus import SUCCESS, ServoBus
from apcc_torch.hardware.servos.port import BusPort
from apcc_torch.hardware.servos.register import Register

try:
    from scservo_sdk import COMM_RX_TIMEOUT, protocol_packet_handler
except ModuleNotFoundError:  # the settings can be read all the same; who builds the driver is told
    protocol_packet_handler = object

# Places in a status packet: header (2), id, length, status, data, checksum.
ID, LENGTH, DATA = 2, 3, 5
LENGTH_WITHOUT_DATA = 2  # the length field counts status and checksum too
REPLY_WITHOUT_DATA = 6
LITTLE_ENDIAN = 0  # the SDK's name for the order of an STS servo's bytes; 1 is that of an SCS servo


class FeetechBus(ServoBus):
    """STS servos on one port.

    Only the SDK's packets are used. Its group read calls a round a success where the last motor answered, whatever the
    others did; its group write sends the last round's values again where one is missing; its ping fails with an
    IndexError on a short reply; and it waits for a silent motor by the wall clock.

    Args:
        port: The port, opened by `open`.
        names: What messages call each id.
    """

    bauds = (38_400, 57_600, 76_800, 115_200, 128_000, 250_000, 500_000, 1_000_000)

    def __init__(self, port: BusPort, names: Mapping[int, str]) -> None:
        super().__init__(port, names)
        self.packets = protocol_packet_handler(port, LITTLE_ENDIAN)

    def _timed_out(self, result: int) -> bool:
        return bool(result == COMM_RX_TIMEOUT)

    def _receive(self) -> tuple[Sequence[int], int]:
        packet, result = self.packets.rxPacket()
        return packet, result

    def _sender(self, packet: Sequence[int]) -> int:
        return packet[ID]

    def _data(self, motor: int, packet: Sequence[int], length: int) -> bytes:
        # The status in the packet is also a register, which every reading has.
        sent = packet[LENGTH] - LENGTH_WITHOUT_DATA
        if sent != length:
            raise CommunicationError(f"{self.name(motor)}: reply with {sent} bytes of data instead of {length}")
        return bytes(packet[DATA : DATA + length])

    def _ask(self, motors: Sequence[int], address: int, length: int) -> None:
        if len(motors) == 1:
            self._check(motors[0], self.packets.readTx(motors[0], address, length))
            return
        result = self.packets.syncReadTx(address, length, list(motors), len(motors))
        if result != SUCCESS:
            raise CommunicationError(f"sync read: {self.packets.getTxRxResult(result)}")
        self.port.setPacketTimeout(len(motors) * (REPLY_WITHOUT_DATA + length))

    def ping(self, motor: int) -> None:
        """See `ServoBus.ping`."""
        self.read(motor, MODEL_NUMBER)

    def write_bytes(self, motor: int, address: int, data: bytes) -> None:
        """See `ServoBus.write_bytes`."""
        self._begin()
        result, _ = self.packets.writeTxRx(motor, address, len(data), list(data))
        self._check(motor, result)

    def write(self, motor: int, register: Register, value: int) -> None:
        """See `ServoBus.write`. Raises ValueRangeError for a value of the torque switch that is no switching."""
        _no_calibration(register, value)
        super().write(motor, register, value)

    def sync_write(self, register: Register, values: Mapping[int, int]) -> None:
        """See `ServoBus.sync_write`. Raises ValueRangeError as `write` does."""
        self._begin()
        for value in values.values():
            _no_calibration(register, value)
        parameters = [byte for motor, value in values.items() for byte in (motor, *register.encode(value))]
        result = self.packets.syncWriteTxOnly(register.address, register.length, parameters, len(parameters))
        if result != SUCCESS:
            raise CommunicationError(f"sync write of {register.name}: {self.packets.getTxRxResult(result)}")


def _no_calibration(register: Register, value: int) -> None:
    """One value of the torque switch moves the zero of a servo's encoder for good: nothing but off and on is sent."""
    if register is TORQUE_SWITCH and value not in (OFF, ON):
        raise ValueRangeError(f"{register.name} must be {OFF} or {ON}, got {value}")
