"""Pressure regulators behind pymodbus's own server, in a process of their own.

Orders come in as JSON lines on standard input, answers go out; it ends with its standard input. Holding registers: the
commands from 0 on, in counts of 10 Pa; ENABLE, WATCHDOG in ms and HEARTBEAT. Input registers: the pressures from 0 on,
in counts of 10 Pa, STATUS and KIND. A pressure follows its command with a lag while outputs are enabled, else it falls.
"""

from __future__ import annotations

import asyncio
import json
import math
import sys
import time
from typing import Any

from pymodbus.constants import ExcCodes
from pymodbus.server import ModbusTcpServer
from pymodbus.simulator import SimData, SimDevice
from pymodbus.simulator.simutils import DataType

ENABLE, WATCHDOG, HEARTBEAT, STATUS, KIND = 10, 11, 12, 20, 21
LAG = 0.05
TRIPPED = 2


class Unit:
    """One unit id with its chambers."""

    def __init__(self, chambers: int) -> None:
        self.chambers = chambers
        self.fresh()

    def fresh(self) -> None:
        """As switched on: no pressure, no fault, nothing ever commanded."""
        self.command, self.pressure = [0.0] * self.chambers, [0.0] * self.chambers
        self.enabled = self.watchdog = self.beat = self.status = self.offset = 0
        self.kind, self.late, self.mute, self.refuse = 77, 0.0, 0, 0
        self.asked = self.moved = time.monotonic()
        self.sent: list[list[int]] = []
        self.log: list[tuple[float, str]] = []

    def now(self) -> None:
        """Brings pressures and watchdog up to date."""
        now = time.monotonic()
        if self.enabled and self.watchdog and now - self.asked > self.watchdog / 1e3:
            self.enabled, self.status = 0, self.status | TRIPPED
            self.log.append((now, "tripped"))
        left = math.exp((self.moved - now) / LAG)
        for k, command in enumerate(self.command):
            goal = command if self.enabled else 0.0
            self.pressure[k] = goal + left * (self.pressure[k] - goal)
        self.moved = now

    def written(self, address: int, values: list[int]) -> None:
        """Takes what a client wrote."""
        for place, value in enumerate(values, address):
            if place < self.chambers:
                self.command[place] = value
            elif place == ENABLE:
                self.enabled = value
                self.log.append((time.monotonic(), f"enable {value}"))
            elif place == WATCHDOG:
                self.watchdog = value
            elif place == HEARTBEAT:
                self.beat = value
        if address == 0:
            self.sent.append([int(value) for value in values[: self.chambers]])

    async def asked_for(
        self, code: int, start: int, address: int, count: int, registers: list[int], values: list[int] | None
    ) -> ExcCodes | None:
        """What pymodbus calls with every request."""
        if self.mute:
            self.mute -= 1
            await asyncio.sleep(3600)
        if self.late:
            await asyncio.sleep(self.late)
        if self.refuse:
            self.refuse -= 1
            return ExcCodes.DEVICE_FAILURE
        self.now()
        self.asked = time.monotonic()
        if values is not None:
            self.written(address, [int(value) for value in values])
        if code == 4:
            for k, pressure in enumerate(self.pressure):
                registers[k - start] = min(max(round(pressure) + self.offset, 0), 65535)
            registers[STATUS - start], registers[KIND - start] = self.status, self.kind
        return None

    def told(self) -> dict[str, Any]:
        """What it has come to."""
        self.now()
        names = ("command", "pressure", "enabled", "watchdog", "beat", "status", "sent", "log")
        return {name: getattr(self, name) for name in names}


def obey(units: dict[int, Unit], order: dict[str, Any]) -> dict[str, Any]:
    """Does an order: {"do": "fresh"}, {"do": "report"}, {"do": "set", "unit": 1, NAME: VALUE}."""
    if order["do"] == "fresh":
        for unit in units.values():
            unit.fresh()
    elif order["do"] == "set":
        for name, value in order.items():
            if name not in ("do", "unit"):
                setattr(units[order["unit"]], name, value)
    return {str(number): unit.told() for number, unit in units.items()}


async def serve(port: int, chambers: dict[int, int]) -> None:
    """The server until standard input ends."""
    units = {number: Unit(many) for number, many in chambers.items()}
    blank = [[SimData(0, count=32, values=0, datatype=DataType.REGISTERS)] for _ in range(4)]
    bits = [SimData(0, count=1, values=False, datatype=DataType.BITS)]
    devices = [
        SimDevice(id=number, simdata=(bits, bits, blank[2], blank[3]), action=unit.asked_for)
        for number, unit in units.items()
    ]
    server = ModbusTcpServer(devices, address=("127.0.0.1", port))
    await server.serve_forever(background=True)
    sys.stdout.write("{}\n")
    sys.stdout.flush()
    loop = asyncio.get_running_loop()
    while line := await loop.run_in_executor(None, sys.stdin.readline):
        sys.stdout.write(json.dumps(obey(units, json.loads(line))) + "\n")
        sys.stdout.flush()
    await server.shutdown()


if __name__ == "__main__":
    asyncio.run(serve(int(sys.argv[1]), {int(k): v for k, v in json.loads(sys.argv[2]).items()}))
