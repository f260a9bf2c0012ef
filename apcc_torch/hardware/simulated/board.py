"""The memory between the simulated arm and its devices: rings of knots and frames one way, a goal the other.

A knot is the tendons' state at the end of a plant step. The arm is computed a little ahead of time, so whoever reads
finds two knots around the present and takes what lies between them.
"""

from __future__ import annotations

from enum import IntEnum

import numpy as np
from numpy.typing import NDArray

from apcc_torch.errors import CommunicationError
from apcc_torch.hardware.interfaces import Array, PoseSample

KNOTS = 32
FRAMES = 64


class Mode(IntEnum):
    """What the motors do."""

    STAND = 0
    """No torque, on the stand it was calibrated on: the tendons are at zero until the motors are first armed."""
    POWERED = 1
    LIMP = 2


def board_type(n_tendons: int, n_bodies: int, n: int) -> np.dtype[np.void]:
    """The layout of a board: all float64 and int64, so that it is the same in every process; `n` true coordinates."""
    knot = [("time", "f8"), ("y", "f8", n_tendons), ("ydot", "f8", n_tendons), ("effort", "f8", n_tendons)]
    frame = [
        *(("stamp", "f8"), ("sequence", "i8"), ("T", "f8", (n_bodies, 4, 4)), ("valid", "i8", n_bodies)),
        ("q", "f8", n),
    ]
    return np.dtype(
        [
            ("knots", knot, KNOTS),
            ("n_knots", "i8"),
            ("frames", frame, FRAMES),
            ("n_frames", "i8"),
            ("goal", "f8", n_tendons),
            ("mode", "i8"),
            ("slip", "f8"),
            ("diverged", "i8"),
        ]
    )


class Board:
    """A view of the memory. The caller holds the lock.

    Args:
        memory: One value of `board_type`, shape ().
    """

    def __init__(self, memory: NDArray[np.void]) -> None:
        self.memory = memory

    def put_knot(self, time: float, y: Array, ydot: Array, effort: Array) -> None:
        """Adds a knot."""
        knot = self.memory["knots"][int(self.memory["n_knots"]) % KNOTS]
        knot["time"], knot["y"], knot["ydot"], knot["effort"] = time, y, ydot, effort
        self.memory["n_knots"] += 1

    def put_frame(self, stamp: float, T: Array, valid: NDArray[np.bool_], q: Array) -> None:
        """Adds a frame of the sensors, and the true arm's coordinates (n,) then."""
        count = int(self.memory["n_frames"])
        frame = self.memory["frames"][count % FRAMES]
        frame["stamp"], frame["sequence"], frame["T"], frame["valid"] = stamp, count + 1, T, valid
        frame["q"] = q
        self.memory["n_frames"] += 1

    def tendons(self, time: float) -> tuple[float, Array, Array, Array]:
        """Stamp, y, ydot and effort at `time`, s, between two knots; at the nearest knot where there are none around.

        Raises:
            CommunicationError: There is no knot yet.
        """
        count = int(self.memory["n_knots"])
        if count == 0:
            raise CommunicationError("the simulated arm has not begun")
        knots = self.memory["knots"]
        for k in range(count - 1, max(count - KNOTS, 0) - 1, -1):
            knot = knots[k % KNOTS]
            if knot["time"] <= time or k == max(count - KNOTS, 0):
                break
        after = knots[min(k + 1, count - 1) % KNOTS]
        span = float(after["time"] - knot["time"])
        share = 0.0 if span <= 0 else min(max((time - float(knot["time"])) / span, 0.0), 1.0)
        y, ydot, effort = ((1.0 - share) * knot[name] + share * after[name] for name in ("y", "ydot", "effort"))
        return float(knot["time"]) + share * span, y, ydot, effort

    def coordinates(self, sequence: int) -> Array | None:
        """The true arm's (n,) at a frame; None where it has been written over."""
        frame = self.memory["frames"][(sequence - 1) % FRAMES]
        return frame["q"].copy() if frame["sequence"] == sequence else None

    def frame(self, until: float) -> PoseSample | None:
        """The newest frame measured at `until`, s, or before; None if there is none."""
        count = int(self.memory["n_frames"])
        for k in range(count - 1, max(count - FRAMES, 0) - 1, -1):
            frame = self.memory["frames"][k % FRAMES]
            if frame["stamp"] <= until:
                valid = frame["valid"].astype(np.bool_)
                T = np.where(valid[:, None, None], frame["T"], np.nan)
                return PoseSample(float(frame["stamp"]), int(frame["sequence"]), T, valid)
        return None
