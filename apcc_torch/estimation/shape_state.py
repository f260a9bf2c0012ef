"""What a `LoadedShape` knows of an arm's shape."""

from __future__ import annotations

from typing import NamedTuple, Self

import torch
from torch import Tensor


class ShapeState(NamedTuple):
    """What is known of the arm's shape.

    sections: (..., n) their bends, rad, and lengths, m: c of `loaded_shape`, and with it the rest lengths.
    load: (...) m at the tip, kg.
    deviation: (..., n + 1) of the strains, rad and m, and of the load, kg, as the last step knew them: the roots of the
        diagonal of `LoadedShape.covariance`; infinite before the first.
    sag: (..., 2, n_f) of the pieces' strains, by the arm's own weight and by each kg at the tip.
    misfit: (...) how far the sensor that is farthest off was from the shape that the last step began with, over the
        standard deviation, squared.
    age: (...) s since it began: headings of inertial units have drifted for so long.
    """

    sections: Tensor
    load: Tensor
    deviation: Tensor
    sag: Tensor
    misfit: Tensor
    age: Tensor

    def where(self, rows: Tensor, other: ShapeState) -> Self:
        """This one in rows (...) bool, the other elsewhere."""
        pairs = zip(self, other, strict=True)
        return type(self)(*(torch.where(rows[(..., *(None,) * (a.dim() - rows.dim()))], a, b) for a, b in pairs))


class ShapeMeasurement(NamedTuple):
    """What is measured of a shape, as `LoadedShape.forward` has it.

    T: (..., k, 4, 4) sensor poses. usable, oriented: (..., k) bool. y: (..., n_a) m. curvature: (..., n_c, 2) 1/m.
    """

    T: Tensor
    usable: Tensor
    oriented: Tensor
    y: Tensor | None
    curvature: Tensor | None = None
