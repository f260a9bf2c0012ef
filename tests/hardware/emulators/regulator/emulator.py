"""A test's handle on the regulators' process."""

from __future__ import annotations

import json
import socket
import subprocess
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Self

TESTS = Path(__file__).resolve().parents[3]


class RegulatorEmulator:
    """Regulators behind pymodbus's own server on loopback, in a process of their own; a context manager.

    Args:
        chambers: Unit id -> how many chambers it drives.
    """

    def __init__(self, chambers: Mapping[int, int]) -> None:
        self.chambers = dict(chambers)
        with socket.create_server(("127.0.0.1", 0)) as free:
            self.port = int(free.getsockname()[1])

    def __enter__(self) -> Self:
        self.start()
        return self

    def __exit__(self, *unused: object) -> None:
        self.stop()

    def start(self) -> None:
        """Switches them on."""
        command = [sys.executable, "-m", "hardware.emulators.regulator", str(self.port), json.dumps(self.chambers)]
        self.process = subprocess.Popen(command, cwd=TESTS, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)
        self._answer()

    def stop(self) -> None:
        """Switches them off. Safe in any state."""
        if self.process.poll() is None:
            self.process.kill()
        self.process.wait(timeout=10)
        for stream in (self.process.stdin, self.process.stdout):
            assert stream is not None
            stream.close()

    def _answer(self) -> dict[str, Any]:
        assert self.process.stdout is not None
        line = self.process.stdout.readline()
        if not line:
            raise RuntimeError(f"the regulators' process ended with {self.process.wait()}")
        answer: dict[str, Any] = json.loads(line)
        return answer

    def do(self, order: str, unit: int | None = None, **details: float) -> dict[int, dict[str, Any]]:
        """One order, see `obey`; returns what every unit has come to."""
        assert self.process.stdin is not None
        whole = {"do": order, **({} if unit is None else {"unit": unit}), **details}
        self.process.stdin.write(json.dumps(whole) + "\n")
        self.process.stdin.flush()
        return {int(number): told for number, told in self._answer().items()}

    def settings(self, **changes: object) -> dict[str, object]:
        """Settings of a driver of all its chambers."""
        units = [number for number, many in self.chambers.items() for _ in range(many)]
        places = [k for many in self.chambers.values() for k in range(many)]
        return {
            "host": "127.0.0.1", "port": self.port, "units": tuple(units), "commands": tuple(places),
            "readings": tuple(places), "upper": 1.2e5, "enable": 10, "watchdog_register": 11, "heartbeat": 12,
            "status": 20, "identity": 21, "kind_number": 77, "reply_timeout": 2.0, "watchdog": 30.0, **changes,
        }  # fmt: skip
