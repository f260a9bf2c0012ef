"""Reads and writes on the servo bus, each reply checked before it is believed.

The SDK packs and unpacks the packets. What it makes of them is not used: after a failed read its group reads return 0,
and of a reply that is too short it returns the checksum as data.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence

from apcc_torch.errors import CommunicationError, DeviceFaultError, HardwareError
from apcc_torch.hardware.dynamixel.port import BusPort
from apcc_torch.hardware.dynamixel.registers import Register

try:
    from dynamixel_sdk import COMM_RX_TIMEOUT, COMM_SUCCESS, Protocol2PacketHandler
except ModuleNotFoundError:  # the settings can be read all the same; who builds the driver is told
    Protocol2PacketHandler = object

# Places in a status packet: header (4), id, length (2), instruction, error, data, checksum (2).
ID, LENGTH, ERROR, DATA = 4, 5, 8, 9
LENGTH_WITHOUT_DATA = 4  # the length field counts instruction, error and checksum too

MAX_PACKETS = 300  # more than there are ids: what else arrives for one request is not an answer
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


class DynamixelBus:
    """Motors on one port.

    Args:
        port: The port, opened by `open`.
        names: What messages call each id.
    """

    def __init__(self, port: BusPort, names: Mapping[int, str]) -> None:
        self.port = port
        self.names = names
        self.packets = PacketHandler()

    @property
    def is_open(self) -> bool:
        """Whether the port is open; an unplugged one still is until it is closed."""
        return bool(self.port.is_open)

    def open(self) -> None:
        """Opens the port. Raises CommunicationError if that fails."""
        self.port.openPort()

    def close(self) -> None:
        """Closes the port. Safe in any state."""
        self.port.closePort()

    def name(self, motor: int) -> str:
        """What messages call the motor: "motor 3 (id 13)"."""
        return f"{self.names.get(motor, 'motor')} (id {motor})"

    def _begin(self) -> None:
        """Frees the line: an exception out of the SDK, Ctrl-C too, leaves it marked as in use."""
        self.port.is_using = False

    def _check(self, motor: int, result: int, error: int) -> None:
        """Raises what the outcome of one exchange means."""
        if result != COMM_SUCCESS:
            said = "no reply" if result == COMM_RX_TIMEOUT else self.packets.getTxRxResult(result)
            raise CommunicationError(f"{self.name(motor)}: {said}")
        self._check_error(motor, error)

    def _check_error(self, motor: int, error: int) -> None:
        code = error & ~ALERT_BIT
        if code == CHECKSUM_ERROR:
            raise CommunicationError(f"{self.name(motor)} received a corrupt packet")
        if code:
            raise DeviceFaultError(f"{self.name(motor)} {ERRORS.get(code, f'answers with error {code}')}")

    def _gather(self, motors: Sequence[int], length: int) -> tuple[dict[int, bytes], dict[int, HardwareError]]:
        """The data (length,) of each motor's reply, and for each motor without a good one the reason.

        Every reply is taken off the line, so that a bad one does not spoil the next exchange.
        """
        answers: dict[int, bytes] = {}
        wrong: dict[int, HardwareError] = {}
        corrupt = False
        for _ in range(MAX_PACKETS):
            if len(answers) + len(wrong) == len(motors):
                break
            packet, result = self.packets.rxPacket(self.port, False)
            if result == COMM_SUCCESS:
                motor = packet[ID]
                if motor in motors and motor not in answers and motor not in wrong:
                    try:
                        answers[motor] = self._data(motor, packet, length)
                    except HardwareError as error:
                        wrong[motor] = error
            elif result == COMM_RX_TIMEOUT:
                break
            else:
                corrupt = True
        said = "corrupt reply" if corrupt else "no reply"
        for motor in motors:
            if motor not in answers and motor not in wrong:
                wrong[motor] = CommunicationError(f"{self.name(motor)}: {said}")
        return answers, wrong

    def _data(self, motor: int, packet: Sequence[int], length: int) -> bytes:
        """The data of one status packet, if its own length field says that there are `length` bytes."""
        self._check_error(motor, packet[ERROR])
        sent = packet[LENGTH] + 256 * packet[LENGTH + 1] - LENGTH_WITHOUT_DATA
        if sent != length:
            raise CommunicationError(f"{self.name(motor)}: reply with {sent} bytes of data instead of {length}")
        return bytes(packet[DATA : DATA + length])

    def ping(self, motor: int) -> None:
        """Raises CommunicationError if the motor does not answer."""
        self._begin()
        _, result, error = self.packets.ping(self.port, motor)
        self._check(motor, result, error)

    def read_bytes(self, motor: int, address: int, length: int) -> bytes:
        """`length` bytes of one motor's control table."""
        self._begin()
        self._check(motor, self.packets.readTx(self.port, motor, address, length), 0)
        answers, wrong = self._gather((motor,), length)
        if wrong:
            raise wrong[motor]
        return answers[motor]

    def read(self, motor: int, register: Register) -> int:
        """One register of one motor."""
        return register.decode(self.read_bytes(motor, register.address, register.length))

    def write_bytes(self, motor: int, address: int, data: bytes) -> None:
        """Writes to one motor's control table; returns when the motor has said that it did."""
        self._begin()
        result, error = self.packets.writeTxRx(self.port, motor, address, len(data), list(data))
        self._check(motor, result, error)

    def write(self, motor: int, register: Register, value: int) -> None:
        """Writes one register of one motor.

        Raises:
            CommunicationError: No good reply.
            DeviceFaultError: The motor refuses.
        """
        try:
            self.write_bytes(motor, register.address, register.encode(value))
        except DeviceFaultError as error:
            raise DeviceFaultError(f"{register.name} = {value}: {error}") from error

    def sync_gather(
        self, motors: Sequence[int], address: int, length: int
    ) -> tuple[dict[int, bytes], dict[int, HardwareError]]:
        """One packet to all, one reply of each: the data of those that answered well, and why the others did not.

        Raises:
            CommunicationError: The port is lost.
        """
        self._begin()
        result = self.packets.syncReadTx(self.port, address, length, list(motors), len(motors), False)
        if result != COMM_SUCCESS:
            raise CommunicationError(f"sync read: {self.packets.getTxRxResult(result)}")
        return self._gather(motors, length)

    def sync_read(self, motors: Sequence[int], address: int, length: int) -> dict[int, bytes]:
        """`length` bytes of every motor.

        Raises:
            CommunicationError: One motor or more did not answer well; the sentence names each.
            DeviceFaultError: All answered, and one refused.
        """
        answers, wrong = self.sync_gather(motors, address, length)
        raise_all(wrong.values())
        return answers

    def sync_write(self, register: Register, values: Mapping[int, int]) -> None:
        """One packet that writes a register of many motors. They do not answer: read back what matters.

        Raises:
            CommunicationError: The packet could not be sent.
        """
        self._begin()
        parameters = [byte for motor, value in values.items() for byte in (motor, *register.encode(value))]
        result = self.packets.syncWriteTxOnly(self.port, register.address, register.length, parameters, len(parameters))
        if result != COMM_SUCCESS:
            raise CommunicationError(f"sync write of {register.name}: {self.packets.getTxRxResult(result)}")


def raise_all(errors: Iterable[HardwareError]) -> None:
    """Raises one error that says all of `errors`, of the class that tells least of the device; none: does nothing."""
    several = list(errors)
    if not several:
        return
    lost = [error for error in several if isinstance(error, CommunicationError)]
    raise (CommunicationError if lost else DeviceFaultError)("; ".join(str(error) for error in several))
