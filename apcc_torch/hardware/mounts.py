"""How each tracked body sits on the arm: from the pose of its markers to the model's frame at its abscissa."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from apcc_torch.errors import ShapeError
from apcc_torch.estimation.rest_calibration import RestCalibration
from apcc_torch.hardware.interfaces import Array


@dataclass(frozen=True)
class Mounts:
    """Constant transforms from the bodies' frames to the model's.

    rotation: (k, 3, 3) the model frame's axes in each body's frame, as columns. offset: (k, 3) the model frame's
    origin in the model frame's axes, as seen from the body's origin, m.

    The two are applied apart: a body's rotation can be wrong where its position is right, and the way from the one
    origin to the other then has to follow the last rotation that was believed.

    Raises:
        ShapeError: The two do not fit.
    """

    rotation: Array
    offset: Array

    def __post_init__(self) -> None:
        """Checks the shapes."""
        k = len(self.offset)
        if self.rotation.shape != (k, 3, 3) or self.offset.shape != (k, 3):
            raise ShapeError(f"mounts must be (k, 3, 3) and (k, 3), got {self.rotation.shape} and {self.offset.shape}")

    @staticmethod
    def of(calibration: RestCalibration) -> Mounts:
        """The mounts of a calibration from the hanging pose, whose offsets are in the bodies' axes."""
        rotation = calibration.mount_rotation.numpy()
        offset = (calibration.mount_rotation.mT @ calibration.mount_offset.unsqueeze(-1)).squeeze(-1)
        return Mounts(rotation, offset.numpy())

    def turned(self, T: Array) -> Array:
        """Poses (k, 4, 4) with the model's axes, at the bodies' own origins, m."""
        turned = T.copy()
        turned[:, :3, :3] = T[:, :3, :3] @ self.rotation
        return turned

    def moved(self, rotation: Array, position: Array) -> Array:
        """The model frames' origins (k, 3), m.

        Args:
            rotation: (k, 3, 3) the model's axes, this frame's or the last that were believed.
            position: (k, 3) the bodies' origins, m.
        """
        return position + np.einsum("kij,kj->ki", rotation, self.offset)
