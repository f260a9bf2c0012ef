"""Sixty seconds of a 100 Hz loop on regulators: `PYTHONPATH=tests python benchmarks/regulators.py`.

The driver talks to pymodbus's own server on loopback, in a process of its own, two units of three chambers. Every turn
reads all pressures and commands all of them. It prints how many exchanges failed, and what a turn took.
"""

from __future__ import annotations

import argparse
import sys
import time

import numpy as np

from apcc_torch.errors import CommunicationError
from apcc_torch.hardware.modbus.actuator import ModbusRegulators
from apcc_torch.hardware.modbus.settings import RegulatorSettings
from hardware.emulators.regulator.emulator import RegulatorEmulator


def main() -> int:
    """Runs it; the number of failed exchanges."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seconds", type=float, default=60.0)
    parser.add_argument("--rate", type=float, default=100.0, help="of the loop, Hz")
    options = parser.parse_args()
    seconds, rate = options.seconds, options.rate
    turns, failed, late = round(seconds * rate), 0, 0
    took = np.zeros(turns)
    with RegulatorEmulator({1: 3, 2: 3}) as server:
        settings = RegulatorSettings(**server.settings(reply_timeout=1.0, watchdog=10.0))
        with ModbusRegulators(settings) as actuator:
            actuator.arm()
            start = time.monotonic()
            for k in range(turns):
                time.sleep(max(start + k / rate - time.monotonic(), 0.0))
                began = time.monotonic()
                try:
                    actuator.read()
                    actuator.send(4e4 + 3e4 * np.sin(2.0 * np.pi * 0.5 * k / rate + np.arange(6)))
                except CommunicationError as error:
                    failed += 1
                    print(error)
                took[k] = time.monotonic() - began
                late += time.monotonic() > start + (k + 1) / rate
    p50, p99 = 1e3 * np.percentile(took, [50, 99])
    print(f"{turns} turns at {rate:g} Hz: {failed} failed exchanges, {late} turns late")
    print(f"a turn: p50 {p50:.2f} ms, p99 {p99:.2f} ms, longest {1e3 * took.max():.2f} ms")
    return failed


if __name__ == "__main__":
    sys.exit(main() > 0)
