"""Reads and writes on a bus of servos, each reply checked before it is believed.

The makers' SDKs pack and unpack the packets. What they make of replies is not used: after a failed read their group
reads return nothing, or what is not there, and call it a success.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterable, Mapping, Sequence
from typing import Any, ClassVar

from apcc_torch.errors import CommunicationError, DeviceFaultError, HardwareError
from apcc_torch.hardware.servos.port import BusPort
from apcc_torch.hardware.servos.register import Register

SUCCESS = 0  # of one exchange, as both SDKs have it
MAX_PACKETS = 300  # more than there are ids: what else arrives for one request is not an answer


class ServoBus(ABC):
    """Motors on one port, in one protocol.

    Args:
        port: The port, opened by `open`.
        names: What messages call each id.
        packets: The SDK's packet handler.
        timeout: The SDK's result where nothing came.
        first: What every call of the handler begins with.
        last: What its calls that receive, or ask many motors, end with.

    Attributes:
        bauds: Rates that motors of this protocol can be set to, bit/s.
        sender, data: Places of the id and of the data in a status packet.
    """

    bauds: ClassVar[tuple[int, ...]]
    sender: ClassVar[int]
    data: ClassVar[int]

    def __init__(
        self,
        port: BusPort,
        names: Mapping[int, str],
        packets: Any,
        timeout: int,
        first: tuple[Any, ...] = (),
        last: tuple[Any, ...] = (),
    ) -> None:
        self.port = port
        self.names = names
        self.packets = packets
        self._timeout, self._first, self._last = timeout, first, last

    @property
    def is_open(self) -> bool:
        """Whether the port is open; an unplugged one still is until it is closed."""
        return self.port.is_open

    def open(self) -> None:
        """Opens the port. Raises CommunicationError if that fails."""
        if self.port.baudrate not in self.bauds:
            raise CommunicationError(f"cannot open the port {self.port.port_name}: no baud rate {self.port.baudrate}")
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

    @abstractmethod
    def ping(self, motor: int) -> None:
        """Raises CommunicationError if the motor does not answer."""

    @abstractmethod
    def _data(self, motor: int, packet: Sequence[int], length: int) -> bytes:
        """The data of one status packet. Raises a HardwareError where it has an error, or another length."""

    @abstractmethod
    def _check_error(self, motor: int, error: int) -> None:
        """Raises a HardwareError where a motor's answer to a write says that it did not."""

    def _cut(self, motor: int, packet: Sequence[int], sent: int, length: int) -> bytes:
        """The data of a packet that has `sent` bytes of it. Raises CommunicationError if those are not `length`."""
        if sent != length:
            raise CommunicationError(f"{self.name(motor)}: reply with {sent} bytes of data instead of {length}")
        return bytes(packet[self.data : self.data + length])

    def _ask(self, motors: Sequence[int], address: int, length: int) -> None:
        """Sends the request that makes each motor send `length` bytes of its table; raises CommunicationError."""
        if len(motors) == 1:
            self._check(motors[0], self.packets.readTx(*self._first, motors[0], address, length))
            return
        ids = list(motors), len(motors)
        self._check_sent("sync read", self.packets.syncReadTx(*self._first, address, length, *ids, *self._last))

    def write_bytes(self, motor: int, address: int, data: bytes) -> None:
        """Writes to one motor's control table; returns when the motor has said that it did."""
        self._begin()
        result, error = self.packets.writeTxRx(*self._first, motor, address, len(data), list(data))
        self._check(motor, result)
        self._check_error(motor, error)

    def sync_write(self, register: Register, values: Mapping[int, int]) -> None:
        """One packet that writes a register of many motors. They do not answer: read back what matters.

        Raises:
            CommunicationError: The packet could not be sent.
        """
        self._begin()
        sent = [byte for motor, value in values.items() for byte in (motor, *register.encode(value))]
        told = register.address, register.length, sent, len(sent)
        self._check_sent(f"sync write of {register.name}", self.packets.syncWriteTxOnly(*self._first, *told))

    def _check(self, motor: int, result: int) -> None:
        """Raises what the result of one exchange means."""
        if result != SUCCESS:
            said = "no reply" if result == self._timeout else self.packets.getTxRxResult(result)
            raise CommunicationError(f"{self.name(motor)}: {said}")

    def _check_sent(self, what: str, result: int) -> None:
        """The same of a packet to many motors."""
        if result != SUCCESS:
            raise CommunicationError(f"{what}: {self.packets.getTxRxResult(result)}")

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
            packet, result = self.packets.rxPacket(*self._first, *self._last)
            if result == SUCCESS:
                motor = packet[self.sender]
                if motor in motors and motor not in answers and motor not in wrong:
                    try:
                        answers[motor] = self._data(motor, packet, length)
                    except HardwareError as error:
                        wrong[motor] = error
            elif result == self._timeout:
                break
            else:
                corrupt = True
        said = "corrupt reply" if corrupt else "no reply"
        for motor in motors:
            if motor not in answers and motor not in wrong:
                wrong[motor] = CommunicationError(f"{self.name(motor)}: {said}")
        return answers, wrong

    def read_bytes(self, motor: int, address: int, length: int) -> bytes:
        """`length` bytes of one motor's control table."""
        self._begin()
        self._ask((motor,), address, length)
        answers, wrong = self._gather((motor,), length)
        if wrong:
            raise wrong[motor]
        return answers[motor]

    def read(self, motor: int, register: Register) -> int:
        """One register of one motor."""
        return register.decode(self.read_bytes(motor, register.address, register.length))

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
        self._ask(motors, address, length)
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


def raise_all(errors: Iterable[HardwareError]) -> None:
    """Raises one error that says all of `errors`, of the class that tells least of the device; none: does nothing."""
    several = list(errors)
    if not several:
        return
    lost = [error for error in several if isinstance(error, CommunicationError)]
    raise (CommunicationError if lost else DeviceFaultError)("; ".join(str(error) for error in several))
