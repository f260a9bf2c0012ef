"""Registers behind one Modbus TCP server: every failure is one error that names the unit, and leaves a clean line."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any

from apcc_torch.errors import CommunicationError, in_a_line

WIDEST = 100
"""Most registers of one request; the protocol allows 123."""


class ModbusLink:
    """A connection to a server; it connects anew after a failure, so that no late reply is taken for another.

    Args:
        host: Of the server.
        port: Its TCP port.
        timeout: s to wait for a reply, and for a connection.
    """

    def __init__(self, host: str, port: int, timeout: float) -> None:
        from pymodbus.client import ModbusTcpClient
        from pymodbus.exceptions import ModbusException

        self.where = f"{host}:{port}"
        self.client: Any = None
        self.made: Callable[[], Any] = lambda: ModbusTcpClient(host, port=port, timeout=timeout, retries=0)
        self.failures: tuple[type[Exception], ...] = (ModbusException, OSError)

    @property
    def is_open(self) -> bool:
        """Whether it was opened and not closed since."""
        return self.client is not None

    def open(self) -> None:
        """Connects.

        Raises:
            CommunicationError: Nobody listens there.
        """
        client = self.made()
        if not client.connect():
            client.close()
            raise CommunicationError(f"no Modbus server answers at {self.where}")
        self.client = client

    def close(self) -> None:
        """Closes the connection. Safe in any state."""
        if self.client is not None:
            self.client.close()
        self.client = None

    def _asked(self, unit: int, what: str, request: Callable[[Any], Any]) -> Any:
        """The reply to a request.

        Raises:
            CommunicationError: There is none, or it is an error.
        """
        if self.client is None:
            raise CommunicationError(f"the connection to {self.where} is not open")
        try:
            reply = request(self.client)
        except self.failures as error:
            self.client.close()  # it connects again with the next request
            raise CommunicationError(f"unit {unit} at {self.where}: no reply to {what}: {in_a_line(error)}") from error
        if reply.isError():
            raise CommunicationError(f"unit {unit} at {self.where} refuses {what}: {in_a_line(reply)}")
        return reply

    def read(self, unit: int, table: str, addresses: Sequence[int]) -> list[int]:
        """What registers of a unit hold, in the order of the addresses, 0 to 65535.

        Raises:
            CommunicationError: No reply, one that is an error, or one of another length.
        """
        held: dict[int, int] = {}
        for begin, end in spans(addresses):
            count = end - begin
            what = f"reading {table} registers {begin} to {end - 1}"

            def request(client: Any, begin: int = begin, count: int = count) -> Any:
                ask = client.read_input_registers if table == "input" else client.read_holding_registers
                return ask(begin, count=count, device_id=unit)

            values = self._asked(unit, what, request).registers
            if len(values) != count:
                raise CommunicationError(f"unit {unit} at {self.where}: {len(values)} instead of {count} registers")
            held |= dict(enumerate(values, begin))
        return [held[address] for address in addresses]

    def write(self, unit: int, values: Mapping[int, int]) -> None:
        """Writes holding registers of a unit, neighbours in one request.

        Raises:
            CommunicationError: No reply, or one that is an error.
        """
        for begin, end in spans(sorted(values), gap=0):
            numbers = [values[address] for address in range(begin, end)]
            what = f"writing holding registers {begin} to {end - 1}"

            def request(client: Any, begin: int = begin, numbers: list[int] = numbers) -> Any:
                return client.write_registers(begin, numbers, device_id=unit)

            self._asked(unit, what, request)


def spans(addresses: Sequence[int], gap: int = 8) -> list[tuple[int, int]]:
    """Ranges (first, last + 1) that hold all addresses, none wider than one request, none with a wider gap in it.

    Example:
        >>> spans([4, 5, 30, 6])
        [(4, 7), (30, 31)]
    """
    found: list[tuple[int, int]] = []
    for address in sorted(addresses):
        if found and address <= found[-1][1] + gap and address < found[-1][0] + WIDEST:
            found[-1] = (found[-1][0], max(found[-1][1], address + 1))
        else:
            found.append((address, address + 1))
    return found
