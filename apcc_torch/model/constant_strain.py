"""Sections of constant strain: bends and elongation as in the PCC model, with torsion and shear beside them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from apcc_torch.errors import ConfigError
from apcc_torch.model.coordinates import BEND_X, BEND_Y, ELONGATION, Coordinate, Coordinates
from apcc_torch.model.strain_backbone import Basis, StrainBackbone
from apcc_torch.model.strain_chain import Chosen
from apcc_torch.settings import OURS, Settings, resolved, setting

# In this order, which is that of the columns below; the elongation is a coordinate of every section.
STRAINS = {
    "bend_x": BEND_X,
    "bend_y": BEND_Y,
    "torsion": Coordinate("torsion", "rad", driven=False),
    "shear_x": Coordinate("shear x", "m", driven=False),
    "shear_y": Coordinate("shear y", "m", driven=False),
    "elongation": ELONGATION,
}
# Of each strain, the entry of the twist (omega, v) that it is, and its sign: bend x turns about y, bend y about -x.
_TWISTS = ((1, 1.0), (0, -1.0), (2, 1.0), (3, 1.0), (4, 1.0), (5, 1.0))


Strains = Sequence[str] | Sequence[Sequence[str]]


@dataclass(frozen=True, kw_only=True)
class ConstantStrainSettings(Settings):
    """Settings of `ConstantStrainBackbone`."""

    strains: Strains = setting(
        tuple(STRAINS),
        "",
        OURS,
        f"those of {', '.join(STRAINS)} of a section; or such a list for each",
    )


class ConstantStrainBackbone(StrainBackbone):
    """Piecewise constant strain, [Renda et al., 2018], with the strains chosen that matter.

    Per section q holds the chosen ones of bend x, bend y and torsion (rad), shear x and shear y (m) and the elongation
    (m), in this order, each over the whole section. A section moves its frame by exp of its strain, which is exact.
    With ("bend_x", "bend_y", "elongation") it is the PCC model. Torsion and shear are not driven: parallel tendons do
    not feel them to first order.

    Args:
        n_sections: Number of sections n_b.
        base_rotation: (3, 3) rotation of the arm's base frame in the world; None for the identity.
        *settings, **changes: See `ConstantStrainSettings`.

    Raises:
        ConfigError: A strain is unknown or named twice, the elongation is missing, or not every section has one.
        ValueRangeError: n_sections < 1, or base_rotation is not a rotation.
        ShapeError: base_rotation is not (3, 3).

    Example:
        >>> backbone = ConstantStrainBackbone(1, strains=("bend_x", "bend_y", "torsion", "elongation"))
        >>> backbone.coordinates.names(backbone.n)
        ['bend x 1', 'bend y 1', 'torsion 1', 'elongation 1']
        >>> backbone.tip(torch.tensor([0.5, 0.0, 0.2, 0.0]), torch.tensor([0.2]))
        tensor([0.0488, 0.0033, 0.1918])
    """

    settings_type = ConstantStrainSettings
    strains: Strains

    def __init__(
        self, n_sections: int = 3, base_rotation: Tensor | None = None, *settings: Any, **changes: Any
    ) -> None:
        s = resolved(ConstantStrainSettings, settings, changes)
        strains = s.strains
        apart = any(not isinstance(names, str) for names in strains)
        chosen = [list(names) for names in strains] if apart else [[str(name) for name in strains]] * n_sections
        if len(chosen) != n_sections:
            raise ConfigError(f"strains must be one list, or one for each of {n_sections} sections, got {len(chosen)}")
        for names in chosen:
            _check(names)
        order = list(STRAINS)
        places = [6 * i + k for i, names in enumerate(chosen) for k, name in enumerate(order) if name in names]
        pattern = tuple(STRAINS[order[p % 6]] for p in places if apart or p < 6)
        # On the CPU, whatever the default device is: `StrainBackbone` takes it to that of the base.
        start = torch.zeros(6, 6, dtype=torch.float64, device="cpu")
        for column, (row, sign) in enumerate(_TWISTS):
            start[row, column] = sign
        basis = Basis(start, None, torch.eye(6, dtype=torch.float64, device="cpu"), None)
        super().__init__(n_sections, Coordinates(pattern), basis, 1, base_rotation, _chosen(places, 6 * n_sections))
        self._shared = None if apart else tuple(chosen[0])
        self.hold(s)

    def resized(self, n_sections: int) -> ConstantStrainBackbone:
        """See `KinematicModel.resized`.

        Raises:
            ConfigError: Each section has strains of its own.
        """
        if self._shared is None:
            raise ConfigError("a model whose sections have strains of their own cannot have another number of sections")
        return ConstantStrainBackbone(n_sections, self.base_rotation, self._shared)


def _check(names: Sequence[str]) -> None:
    for name in names:
        if name not in STRAINS:
            raise ConfigError(f"strains must be some of {', '.join(STRAINS)}, got {name!r}")
    if len(set(names)) != len(names):
        raise ConfigError(f"strains names one twice: {', '.join(names)}")
    if "elongation" not in names:
        raise ConfigError(f"strains must hold elongation, whose column is the regressor's, got {', '.join(names)}")


def _chosen(places: list[int], size: int) -> Chosen | None:
    """None where all are chosen."""
    if len(places) == size:
        return None
    entries = [len(places)] * size
    for entry, place in enumerate(places):
        entries[place] = entry
    return Chosen(*(torch.tensor(numbers, dtype=torch.int64, device="cpu") for numbers in (places, entries)))
