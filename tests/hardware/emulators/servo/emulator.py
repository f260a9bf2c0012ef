"""A test's handle on the emulator's process."""

from __future__ import annotations

import json
import subprocess
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Any

TESTS = Path(__file__).resolve().parents[3]


class ServoEmulator:
    """Motors on a pseudo terminal named `link`, in a process of their own.

    Args:
        link: Name of the terminal, as /dev/serial/by-id gives one.
        motors: id -> start position in ticks.
        models: id -> model number, where it is not the protocol's usual one.
        program: The package of its protocol.
    """

    def __init__(
        self,
        link: Path,
        motors: Mapping[int, int],
        models: Mapping[int, int] | None = None,
        program: str = "hardware.emulators.servo",
    ) -> None:
        self.link = link
        command = [sys.executable, "-m", program, str(link), json.dumps(dict(motors)), json.dumps(dict(models or {}))]
        self.process = subprocess.Popen(command, cwd=TESTS, stdin=subprocess.PIPE, stdout=subprocess.PIPE)
        self._answer()

    def _answer(self) -> dict[str, Any]:
        assert self.process.stdout is not None
        line = self.process.stdout.readline()
        if not line:
            raise RuntimeError(f"the emulator ended with {self.process.wait()}")
        answer: dict[str, Any] = json.loads(line)
        if "error" in answer:
            raise ValueError(answer["error"])
        return answer

    def do(self, order: str, motor: int | None = None, **details: float) -> dict[str, Any]:
        """One order, see `Line.command`; returns its answer."""
        assert self.process.stdin is not None
        whole = {"do": order, **({} if motor is None else {"id": motor}), **details}
        self.process.stdin.write(json.dumps(whole).encode() + b"\n")
        self.process.stdin.flush()
        return self._answer()

    def report(self) -> dict[int, dict[str, Any]]:
        """What each motor has to say, see `Line._report`: its position, its goals, its torque."""
        return {int(identity): found for identity, found in self.do("report").items()}

    def close(self) -> None:
        assert self.process.stdin is not None and self.process.stdout is not None
        self.process.stdin.close()
        self.process.wait(timeout=10)
        self.process.stdout.close()
