"""The serial port under a maker's SDK: a monotonic clock, a short reply timeout, and one error for a lost port."""

from __future__ import annotations

import time
from collections.abc import Sequence

from apcc_torch.errors import CommunicationError
from apcc_torch.plain_text import plain_logger

try:
    from serial import Serial
except ModuleNotFoundError:  # the settings can be read all the same; who builds the driver is told
    Serial = None

log = plain_logger(__name__)

BITS_PER_BYTE = 10
# s that one read sleeps for bytes. The SDK polls; without this it spins, and starves whatever else needs the core.
WAIT = 1e-3
# s after which a line that takes no bytes counts as lost. Not shorter: the clock also runs while other programs run.
WRITE_TIMEOUT = 1.0
# Reads beyond the timeout, while there are bytes: a program that was held up must not take what came for too late.
GRACE = 16
# What may lie in the buffer before it is taken for a line that never falls silent.
MAX_STALE_READS = 16


class BusPort:
    """What the SDKs' packet handlers ask of their port, by the names that they call.

    Dynamixel's and Feetech's SDK have the same port, and it lacks the same: its timeouts take the wall clock and wait
    34 or 50 ms for a missing motor, and unplugging the adapter leaves it marked as in use. Here every failure of the
    line is a `CommunicationError` and leaves the port free to be reopened.

    Args:
        name: Device, as in "/dev/ttyUSB0".
        baud: bit/s.
        reply_timeout: s to wait for a reply beyond the time its bytes need on the line.
    """

    def __init__(self, name: str, baud: int, reply_timeout: float) -> None:
        self.port_name = name
        self.baudrate = baud
        self.reply_timeout = reply_timeout
        self.ser: Serial | None = None
        self.is_open = self.is_using = False
        self.tx_time_per_byte = BITS_PER_BYTE * 1e3 / baud  # ms
        self.packet_start_time = self.packet_timeout = 0.0  # ms
        self.grace = 0

    def openPort(self) -> None:
        """Opens the port for this process alone, with writes that never wait for ever.

        Raises:
            CommunicationError: It is not there, is in use, or does not know the baud rate.
        """
        self.closePort()
        try:
            self.ser = Serial(self.port_name, self.baudrate, timeout=WAIT, write_timeout=WRITE_TIMEOUT, exclusive=True)
        except (OSError, ValueError) as error:
            raise CommunicationError(f"cannot open the port {self.port_name}: {error}") from error
        self.is_open = True
        self.is_using = False
        try:
            self.ser.set_low_latency_mode(True)
        except (OSError, ValueError, NotImplementedError) as error:
            # Only an FTDI adapter has the mode; others do not delay.
            log.debug("%s has no low-latency mode: %s", self.port_name, error)

    def closePort(self) -> None:
        """Closes the port. Safe in any state."""
        if self.ser is not None:
            try:
                self.ser.close()
            except OSError as error:
                log.debug("closing %s: %s", self.port_name, error)
        self.ser = None
        self.is_open = False
        self.is_using = False

    def _lost(self, error: Exception) -> CommunicationError:
        self.is_using = False
        return CommunicationError(f"lost the port {self.port_name}: {error}")

    def getBytesAvailable(self) -> int:
        """How many bytes have come and are not read."""
        if self.ser is None:
            raise CommunicationError(f"the port {self.port_name} is not open")
        try:
            return int(self.ser.in_waiting)
        except OSError as error:
            raise self._lost(error) from error

    def readPort(self, length: int) -> bytes:
        """The bytes that come within `WAIT`, `length` at most."""
        if self.ser is None:
            raise CommunicationError(f"the port {self.port_name} is not open")
        try:
            return bytes(self.ser.read(length))
        except OSError as error:
            raise self._lost(error) from error

    def writePort(self, packet: Sequence[int]) -> int:
        """Writes a packet; returns the number of bytes written."""
        if self.ser is None:
            raise CommunicationError(f"the port {self.port_name} is not open")
        try:
            return int(self.ser.write(bytes(packet)))
        except OSError as error:
            raise self._lost(error) from error

    def clearPort(self) -> None:
        """Drops what earlier, late replies left, by reading it: flushing a lost port raises no error that is named."""
        for _ in range(MAX_STALE_READS):
            if not (stale := self.getBytesAvailable()):
                return
            self.readPort(stale)
        raise CommunicationError(f"the port {self.port_name} never falls silent: something else sends on the bus")

    def getCurrentTime(self) -> float:
        """ms, monotonic."""
        return time.monotonic() * 1e3

    def getTimeSinceStart(self) -> float:
        """ms since the wait began."""
        return self.getCurrentTime() - self.packet_start_time

    def setPacketTimeoutMillis(self, milliseconds: float) -> None:
        """Starts a wait."""
        self.packet_start_time = self.getCurrentTime()
        self.packet_timeout = milliseconds

    def setPacketTimeout(self, packet_length: int) -> None:
        """Starts the wait for a reply of `packet_length` bytes."""
        self.setPacketTimeoutMillis(self.tx_time_per_byte * packet_length + 1e3 * self.reply_timeout)
        self.grace = GRACE

    def isPacketTimeout(self) -> bool:
        """Whether the reply is overdue and nothing of it lies here unread."""
        if self.getTimeSinceStart() <= self.packet_timeout:
            return False
        if self.grace > 0 and self.getBytesAvailable():
            self.grace -= 1
            return False
        self.packet_timeout = 0.0
        return True
