"""The Feetech bus: its protocol as the SDK packs it, half-duplex on one wire."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from apcc_torch.errors import ValueRangeError
from apcc_torch.hardware.feetech.registers import MODEL_NUMBER, OFF, ON, TORQUE_SWITCH
from apcc_torch.hardware.servos.bus import ServoBus
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

    sender, data = ID, DATA
    bauds = (38_400, 57_600, 76_800, 115_200, 128_000, 250_000, 500_000, 1_000_000)

    def __init__(self, port: BusPort, names: Mapping[int, str]) -> None:
        super().__init__(port, names, protocol_packet_handler(port, LITTLE_ENDIAN), COMM_RX_TIMEOUT)

    def _check_error(self, motor: int, error: int) -> None:
        """Nothing: the status in the packet is also a register, which every reading has."""

    def _data(self, motor: int, packet: Sequence[int], length: int) -> bytes:
        return self._cut(motor, packet, packet[LENGTH] - LENGTH_WITHOUT_DATA, length)

    def _ask(self, motors: Sequence[int], address: int, length: int) -> None:
        super()._ask(motors, address, length)
        if len(motors) > 1:  # the SDK counts on one reply
            self.port.setPacketTimeout(len(motors) * (REPLY_WITHOUT_DATA + length))

    def ping(self, motor: int) -> None:
        """See `ServoBus.ping`."""
        self.read(motor, MODEL_NUMBER)

    def write(self, motor: int, register: Register, value: int) -> None:
        """See `ServoBus.write`. Raises ValueRangeError for a value of the torque switch that is no switching."""
        _no_calibration(register, value)
        super().write(motor, register, value)

    def sync_write(self, register: Register, values: Mapping[int, int]) -> None:
        """See `ServoBus.sync_write`. Raises ValueRangeError as `write` does."""
        for value in values.values():
            _no_calibration(register, value)
        super().sync_write(register, values)


def _no_calibration(register: Register, value: int) -> None:
    """One value of the torque switch moves the zero of a servo's encoder for good: nothing but off and on is sent."""
    if register is TORQUE_SWITCH and value not in (OFF, ON):
        raise ValueRangeError(f"{register.name} must be {OFF} or {ON}, got {value}")
