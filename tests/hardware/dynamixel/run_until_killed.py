"""A program that moves the arm until somebody kills it. Its argument is the port."""

from __future__ import annotations

import sys
import time
from pathlib import Path

import numpy as np

from apcc_torch.hardware.dynamixel.actuator import DynamixelActuator
from hardware.dynamixel.rig import settings


def main() -> None:
    slow = settings(Path(sys.argv[1]), bus_watchdog=0.4, profile_velocity=0.2)
    with DynamixelActuator(slow) as actuator:
        actuator.calibrate()
        actuator.arm()
        for k in range(10_000):
            actuator.read()
            actuator.send(np.full(9, -0.03))
            if k == 10:
                sys.stdout.write("moving\n")
                sys.stdout.flush()
            time.sleep(0.01)


if __name__ == "__main__":
    main()
