"""The arm between the emulated motors and the emulated cameras: tendon lengths to poses, by kinematics alone.

Three constant-curvature sections, a rack of three tendons at the end of each, coupled: what a rack's tendons are pulled
in by is y = B^T q over the sections before it, nine equations for nine coordinates. It has no mass, no compliance, no
slack and no weight, so it does not drop when torque goes off. It is written on its own, from the paper's Eqs. (1) and
(42)-(46), and shares no code with the toolkit.
"""

from __future__ import annotations

import mmap
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

HANGING = np.diag([1.0, -1.0, -1.0])
PIVOT = np.array([0.0, 0.0, 0.0205])  # of the arm's base in the frame of the base's rigid body, m
OFFSET, TWIST = 0.027, np.pi / 6


def section(dx: float, dy: float, length: float) -> np.ndarray:
    """(4, 4) the end of a section in the frame of its beginning."""
    D = np.hypot(dx, dy)
    a = 1.0 - D**2 / 6 if D < 1e-4 else np.sin(D) / D
    b = 0.5 - D**2 / 24 if D < 1e-4 else (1.0 - np.cos(D)) / D**2
    T = np.eye(4)
    T[:3, :3] = [
        [1 - dx * dx * b, -dx * dy * b, dx * a],
        [-dx * dy * b, 1 - dy * dy * b, dy * a],
        [-dx * a, -dy * a, 1 - D * D * b],
    ]
    T[:3, 3] = length * np.array([dx * b, dy * b, a])
    return T


def lengths_matrix(sections: int = 3) -> np.ndarray:
    """(9, 9) M with y = M q, rack by rack."""
    M = np.zeros((3 * sections, 3 * sections))
    for rack in range(sections):
        for k in range(3):
            angle = TWIST * rack + 2 * np.pi * k / 3
            row = [-OFFSET * np.cos(angle), -OFFSET * np.sin(angle), 1.0]
            M[3 * rack + k, : 3 * (rack + 1)] = row * (rack + 1)
    return M


TO_COORDINATES = np.linalg.inv(lengths_matrix())


@dataclass
class EmulatedArm:
    """Poses that a NatNet server streams, of the motors' positions; a function of time that other processes can load.

    positions: The file in which the servo emulator tells them. zeros: Ticks at which the arm hangs straight.
    metres_per_tick: With sign. lengths: m. base: Pose (4, 4) of the arm's base in Motive's z-up world.
    """

    positions: Path
    zeros: Sequence[int]
    metres_per_tick: Sequence[float]
    lengths: Sequence[float] = (0.105, 0.255, 0.240)
    base: np.ndarray = field(default_factory=lambda: placed(0.3, -0.2, 1.5))

    def __getstate__(self) -> dict[str, Any]:
        return {name: value for name, value in vars(self).items() if name != "memory"}

    def tendons(self) -> np.ndarray:
        """(9,) length changes, m."""
        if not hasattr(self, "memory"):
            with self.positions.open("rb") as file:
                self.memory = mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ)
        ticks = np.frombuffer(self.memory[: 8 * len(self.zeros)])
        return np.array(self.metres_per_tick) * (ticks - np.array(self.zeros))

    def __call__(self, time: float) -> np.ndarray:
        """(4, 7) base and bodies, as Motive has them with their orientations reset on the hanging arm."""
        q = (TO_COORDINATES @ self.tendons()).reshape(3, 3)
        T = np.eye(4)
        T[:3, :3] = HANGING
        turns, places = [self.base[:3, :3]], [self.base[:3, 3] - self.base[:3, :3] @ PIVOT]
        for (dx, dy, dl), rest in zip(q, self.lengths, strict=True):
            T = T @ section(dx, dy, rest + dl)
            world = self.base @ T
            turns.append(world[:3, :3] @ HANGING.T)
            places.append(world[:3, 3])
        # All at once: scipy takes longer to begin than to compute, and this runs at every frame.
        return np.concatenate((places, Rotation.from_matrix(np.stack(turns)).as_quat()), axis=-1)


def placed(x: float, y: float, z: float, yaw: float = 0.4) -> np.ndarray:
    """A pose (4, 4) that stands upright."""
    T = np.eye(4)
    T[:3, :3] = Rotation.from_euler("z", yaw).as_matrix()
    T[:3, 3] = x, y, z
    return T
