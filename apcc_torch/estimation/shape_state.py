"""What a `LoadedShape` knows of an arm's shape."""

from __future__ import annotations

from typing import NamedTuple

from torch import Tensor


class ShapeState(NamedTuple):
    """What is known of the arm's shape.

    sections: (..., n) their bends, rad, and lengths, m: c of `loaded_shape`, and with it the rest lengths.
    load: (...) m at the tip, kg. variance: (...) of it, over that of before it is felt.
    sag: (..., 2, n_f) of the pieces' strains, by the arm's own weight and by each kg at the tip.
    misfit: (...) how far the sensor that is farthest off was from the shape that the last step began with, over the
        standard deviation, squared.
    age: (...) s since it began: headings of inertial units have drifted for so long.
    """

    sections: Tensor
    load: Tensor
    variance: Tensor
    sag: Tensor
    misfit: Tensor
    age: Tensor
