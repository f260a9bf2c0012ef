"""The emulated Feetech bus in a process of its own."""

from __future__ import annotations

from hardware.emulators.feetech.line import FeetechLine
from hardware.emulators.serve import serve

if __name__ == "__main__":
    serve(FeetechLine)
