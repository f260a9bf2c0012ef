"""What each sensor along an arm measures: a pose, a position, or an orientation whose heading may not be known."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from apcc_torch.errors import ConfigError
from apcc_torch.settings import check_choice

POSE, POSITION, ORIENTATION, TILT = KINDS = ("pose", "position", "orientation", "tilt")
"""An inertial unit measures an orientation with a heading that drifts, or a tilt, which is one without a heading."""
PLACED, INERTIAL = (POSE, POSITION), (ORIENTATION, TILT)


class SensorKinds(NamedTuple):
    """Kinds of k sensors, from the base to the tip, not all of them poses.

    Example:
        >>> kinds = SensorKinds(("orientation", "position", "pose"))
        >>> kinds.placed.tolist(), kinds.turned.tolist(), kinds.inertial
        ([False, True, True], [True, False, True], [0])
    """

    names: tuple[str, ...]

    @property
    def placed(self) -> Tensor:
        """(k,) bool, sensors that measure a position."""
        return torch.tensor([name in PLACED for name in self.names])

    @property
    def turned(self) -> Tensor:
        """(k,) bool, sensors that measure an orientation, perhaps but for its heading."""
        return torch.tensor([name != POSITION for name in self.names])

    @property
    def inertial(self) -> list[int]:
        """Which sensors are inertial units."""
        return [k for k, name in enumerate(self.names) if name in INERTIAL]

    @property
    def drifting(self) -> Tensor:
        """(k,) bool, the same."""
        return torch.tensor([name in INERTIAL for name in self.names])

    @property
    def headed(self) -> Tensor:
        """(p,) bool, which of the p inertial units tell a heading."""
        return torch.tensor([self.names[k] == ORIENTATION for k in self.inertial])

    def check_placed(self) -> None:
        """Raises ConfigError where none measures a position, which algorithm 2 needs."""
        if not self.placed.any():
            raise ConfigError(
                "algorithm 2 takes positions and poses, and arm.sensed names none: let adaptation=shape estimate the "
                "shape, with controller.adaptive=true"
            )

    def filled(self, T: Tensor) -> Tensor:
        """Poses T (..., k, 4, 4) with what is not measured at rest in the origin: nothing reads it, whatever it is."""
        eye = torch.eye(4, dtype=T.dtype, device=T.device)
        measured = torch.zeros(len(self.names), 4, 4, dtype=torch.bool, device=T.device)
        measured[..., 3, :] = True
        measured[..., :3, :3] = self.turned.to(T.device)[..., None, None]
        measured[..., :3, 3] = self.placed.to(T.device)[..., None]
        return torch.where(measured, T, eye)

    def blanked(self, T: Tensor) -> Tensor:
        """Poses T (..., k, 4, 4) with NaN for what is not measured."""
        return torch.where(torch.isnan(self.filled(torch.full_like(T, torch.nan))), T, torch.nan)


def sensor_kinds(names: tuple[str, ...] | None, k: int) -> SensorKinds | None:
    """The kinds of k sensors; None where all are poses.

    Raises:
        ConfigError: They are not k names, or one is no kind.
    """
    if names is None:
        return None
    if len(names) != k:
        raise ConfigError(f"sensed must name a kind for each of the {k} sensors, got {len(names)}")
    for i, name in enumerate(names):
        check_choice(f"sensed[{i}]", name, KINDS)
    return None if all(name == POSE for name in names) else SensorKinds(names)
