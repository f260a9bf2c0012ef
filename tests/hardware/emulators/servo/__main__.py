"""The emulated Dynamixel bus in a process of its own."""

from __future__ import annotations

from hardware.emulators.serve import serve
from hardware.emulators.servo.line import DynamixelLine

if __name__ == "__main__":
    serve(DynamixelLine)
