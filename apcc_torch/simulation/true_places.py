"""Where the true arm's sensors and tendons are, where that is not where they are believed to be."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from apcc_torch.errors import ValueRangeError
from apcc_torch.model.arm import Arm
from apcc_torch.modes import holds
from apcc_torch.settings import OURS, Setting, Settings, aligned, setting
from apcc_torch.spread import spread


@dataclass(frozen=True, kw_only=True)
class PlaceErrors(Settings):
    """By how much the true arm's sensors and tendons are off; each alike for all of its kind.

    Example:
        >>> PlaceErrors(sensors=-0.01).on(Arm(lengths=[0.2, 0.25])).true_sensor_places()
        tensor([0.1900, 0.4400], dtype=torch.float64)
    """

    sensors: Setting = setting(
        0.0, "m", OURS, "along the arm; negative: nearer to the base than believed", rows="number", least=-30, most=30
    )
    tendons: Setting = setting(
        0.0, "m", OURS, "across the arm; positive: farther from the backbone", rows="number", least=-30, most=30
    )

    def on(self, arm: Arm) -> Arm:
        """The arm with its sensors and tendons where they are.

        Args:
            arm: Without the errors.

        Raises:
            ValueRangeError: A sensor would lie beyond the arm, or a tendon beyond the backbone.
        """
        changes: dict[str, Any] = {}
        offsets: Setting
        if _is_off(self.sensors):
            places = arm.true_sensor_places() + aligned(self.sensors, 1)
            if not holds((places > 0) & (places <= arm.rest_lengths().sum(-1, keepdim=True) * (1.0 + 1e-6))):
                raise ValueRangeError(f"sensors must leave every sensor on the arm, got {places.tolist()} m")
            changes["true_sensors"] = places if places.dim() > 1 else tuple(places.tolist())
        if _is_off(self.tendons):
            if arm.chambers is not None:
                offsets = spread("chambers.offsets", arm.chambers.offsets, arm.n_tendons) + aligned(self.tendons, 1)
                changes["chambers"] = arm.chambers.changed(offsets=offsets)
            elif arm.tendons.offsets is not None:
                offsets = spread("tendons.offsets", arm.tendons.offsets, arm.n_tendons) + aligned(self.tendons, 1)
                changes["tendons"] = arm.tendons.changed(offsets=offsets)
            else:
                offsets = changes["tendon_offset"] = arm.tendon_offset + self.tendons
            if not holds(torch.as_tensor(offsets) > 0):
                raise ValueRangeError("tendons must leave every tendon off the backbone")
        return arm.changed(**changes)


def _is_off(value: Setting) -> bool:
    return isinstance(value, Tensor) or value != 0
