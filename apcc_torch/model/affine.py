"""Sections whose curvature varies affinely along them: the next model after constant curvature."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from apcc_torch.model.coordinates import BEND_X, BEND_Y, ELONGATION, Coordinate, Coordinates
from apcc_torch.model.strain_backbone import Basis, StrainBackbone
from apcc_torch.settings import MANY, OURS, Settings, resolved, setting

SLOPE_X = Coordinate("slope x", "rad", driven=False)
SLOPE_Y = Coordinate("slope y", "rad", driven=False)


@dataclass(frozen=True, kw_only=True)
class AffineSettings(Settings):
    """Settings of `AffineBackbone`."""

    rods: int = setting(
        4, "", OURS, "rods of constant strain a section; their error falls by its 4th power", least=1, most=MANY
    )


class AffineBackbone(StrainBackbone):
    """Piecewise affine curvature: at the normalised abscissa s a section bends by theta + (2 s - 1) sigma rad per unit.

    Per section q is (theta_x, theta_y, sigma_x, sigma_y, delta L): theta (rad) is the bend over the whole section, as
    Delta of the PCC model; the slope sigma (rad) is how much more the section bends at its tip, and less at its base.
    With sigma = 0 it is the PCC model. Slopes are not driven: a tendon along a whole section feels theta alone.

    No closed form exists in space, so a section is cut into rods, see `strain_backbone`. With |theta| and |sigma| up to
    1 rad, four rods place its tip within 1e-4 of its length, and the error falls with the fourth power of
    their number.

    Args:
        n_sections: Number of sections n_b.
        base_rotation: (3, 3) rotation of the arm's base frame in the world; None for the identity.
        *settings, **changes: See `AffineSettings`.

    Raises:
        ValueRangeError: n_sections or rods < 1, or base_rotation is not a rotation.
        ShapeError: base_rotation is not (3, 3).

    Example:
        >>> backbone, L0 = AffineBackbone(1, rods=8), torch.tensor([0.2])
        >>> backbone.coordinates.names(backbone.n)
        ['bend x 1', 'bend y 1', 'slope x 1', 'slope y 1', 'elongation 1']
        >>> backbone.tip(torch.tensor([0.5, 0.0, 0.2, 0.0, 0.0]), L0)
        tensor([0.0425, 0.0000, 0.1933])
    """

    settings_type = AffineSettings
    rods: int

    def __init__(
        self, n_sections: int = 3, base_rotation: Tensor | None = None, *settings: Any, **changes: Any
    ) -> None:
        s = resolved(AffineSettings, settings, changes)
        # On the CPU, whatever the default device is: `StrainBackbone` takes them to that of the base.
        start, slope = (torch.zeros(6, 5, dtype=torch.float64, device="cpu") for _ in range(2))
        # omega = (-(theta_y + (2 s - 1) sigma_y), theta_x + (2 s - 1) sigma_x, 0), v = (0, 0, L).
        start[0, 1], start[0, 3], slope[0, 3] = -1.0, 1.0, -2.0
        start[1, 0], start[1, 2], slope[1, 2] = 1.0, -1.0, 2.0
        start[5, 4] = 1.0
        # Up to s: theta becomes s theta + (s^2 - s) sigma, sigma becomes s^2 sigma, L becomes s L.
        first, second = (torch.zeros(5, 5, dtype=torch.float64, device="cpu") for _ in range(2))
        first[0, 0] = first[1, 1] = first[4, 4] = 1.0
        first[0, 2] = first[1, 3] = -1.0
        second[0, 2] = second[1, 3] = second[2, 2] = second[3, 3] = 1.0
        coordinates = Coordinates((BEND_X, BEND_Y, SLOPE_X, SLOPE_Y, ELONGATION))
        super().__init__(n_sections, coordinates, Basis(start, slope, first, second), s.rods, base_rotation)
        self.hold(s)

    def resized(self, n_sections: int) -> AffineBackbone:
        """See `KinematicModel.resized`."""
        return AffineBackbone(n_sections, self.base_rotation, self.rods)
