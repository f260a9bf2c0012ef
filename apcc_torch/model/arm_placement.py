"""Where an arm stands in the frame of what measures it."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from apcc_torch.errors import ConfigError
from apcc_torch.lie import so3
from apcc_torch.settings import OURS, Settings, setting

_DOWN = (0.0, 0.0, -9.81)


@dataclass(frozen=True, kw_only=True)
class Placement(Settings):
    """The arm's base in the frame of a recording, and gravity there. The default is an arm at the origin, z upward."""

    position: tuple[float, ...] = setting((0.0, 0.0, 0.0), "m", OURS, "of the base in the recording's frame")
    rotation: tuple[float, ...] | None = setting(
        None, "rad", OURS, "rotation vector of the base's axes in the recording's frame; null: as `base` says"
    )
    gravity: tuple[float, ...] = setting(_DOWN, "m/s^2", OURS, "acceleration of gravity in the recording's frame")

    def check(self) -> None:
        """Raises ConfigError where one of them is not three numbers."""
        for name in ("position", "rotation", "gravity"):
            value = getattr(self, name)
            if value is not None and len(value) != 3:
                raise ConfigError(f"{name} must be three numbers, got {list(value)}")

    @property
    def acceleration(self) -> float:
        """Size of gravity, m/s^2."""
        return math.hypot(*self.gravity)

    def upright(self) -> Tensor:
        """(3, 3) the shortest rotation of the recording's axes that turns gravity to -z; identity without gravity.

        It takes the recording's frame to the world of the dynamics.
        """
        size = self.acceleration
        if not size:
            return torch.eye(3, dtype=torch.float64)
        x, y, z = (component / size for component in self.gravity)
        angle, sine = math.atan2(math.hypot(x, y), -z), math.hypot(x, y)
        # The axis is gravity x (0, 0, -1); any level one serves where gravity points up.
        axis = (-y / sine, x / sine, 0.0) if sine else (1.0, 0.0, 0.0)
        return so3.exp(angle * torch.tensor(axis, dtype=torch.float64))
