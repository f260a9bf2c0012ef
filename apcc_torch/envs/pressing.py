"""What the chambers of a dynamic arm are told, by an action or for a desired configuration, and what is seen of it."""

from __future__ import annotations

from typing import Self

import torch
from torch import Tensor

from apcc_torch.control.pressure import PressureControl, PressureControlSettings
from apcc_torch.errors import ConfigError
from apcc_torch.model.arm import Arm
from apcc_torch.part import Part


class Pressing(Part):
    """Pressures of N arms of one kind. Nothing measures a chamber's length, so no loop holds one.

    Args:
        arm: What the arms are nominally.
        like: Dtype and device.

    Raises:
        ConfigError: It has no chambers.

    Example:
        >>> pressing = Pressing(Arm.load("soft_trunk"), torch.empty(0))
        >>> pressing.asked(torch.tensor([[-1.0, 0.0, 1.0, 1.0, 0.0, -1.0]]))
        tensor([[     0.,  60000., 120000., 120000.,  60000.,      0.]])
    """

    greatest: Tensor

    def __init__(self, arm: Arm, like: Tensor) -> None:
        super().__init__()
        control = PressureControl.on(arm, PressureControlSettings())
        if control is None:
            raise ConfigError("action='pressures' needs an arm with chambers: arm.chambers is null")
        self.control = control.to(like)
        least, most = self.limits
        self.register_buffer("greatest", torch.maximum(least.abs(), most.abs()))

    @classmethod
    def of(cls, arm: Arm, like: Tensor, action: str) -> Self | None:
        """Those of a dynamic arm; None of one with tendons, whose actions are no pressures."""
        return cls(arm, like) if arm.chambers is not None or action == "pressures" else None

    @property
    def limits(self) -> tuple[Tensor, Tensor]:
        """(n_a,) Pa, the least and the most that may be commanded."""
        chambers = self.control.chambers
        assert chambers.least is not None and chambers.most is not None  # an arm's chambers have both
        return chambers.least, chambers.most

    def at_rest(self, q_d: Tensor) -> Tensor:
        """(N, n_a) Pa, the pressures of rest, for rows of the form of q_d (N, n)."""
        return self.control.chambers.rest.expand(*q_d.shape[:-1], -1).clone()

    def asked(self, action: Tensor) -> Tensor:
        """(N, n_a) Pa of an action (N, n_a): -1 is the least, 1 the most that may be commanded."""
        least, most = self.limits
        return torch.lerp(least, most, 0.5 * (action + 1.0))

    def holding(self, y_d: Tensor) -> Tensor:
        """(N, n_a) Pa that hold the nominal arm at rest with chambers changed by y_d (N, n_a), m."""
        return self.control.holding(y_d)

    def seen(self, p: Tensor) -> Tensor:
        """Pressures (N, n_a) over the greatest that may be commanded."""
        return p / self.greatest
