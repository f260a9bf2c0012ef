"""Static shapes of a rod under known wrenches, in the files that SoRoSim's reference data are published in."""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple

import torch
from torch import Tensor

from apcc_torch.errors import DataError
from apcc_torch.recordings.csv_table import read_table

TO_ARM = ((0.0, 0.0, 1.0), (0.0, -1.0, 0.0), (1.0, 0.0, 0.0))
"""The file's axes, in which the rod lies along x, in the arm's."""
FIRST = ("gravity", "mid_wrench", "tip_wrench")
ROWS = 6


class RodShapes(NamedTuple):
    """N shapes of a rod that begins at the origin and, unloaded, lies along z.

    gravity: (N, 3) m/s^2. middle, tip: (N, 6) torque, N m, and force, N, in world axes. shares: (m,) of the rod's half
    that lie before a station of it. places: (N, 2, m, 3) of the stations of both halves, m.
    """

    gravity: Tensor
    middle: Tensor
    tip: Tensor
    shares: Tensor
    places: Tensor

    def each(self, every: int) -> RodShapes:
        """Every so many-th of the shapes."""
        gravity, middle, tip, places = (
            value[::every] for value in (self.gravity, self.middle, self.tip, self.places)
        )  # fmt: skip
        return RodShapes(gravity, middle, tip, self.shares, places)


def read_rod_shapes(path: Path) -> RodShapes:
    """Reads a file: the stations, then six rows a shape, three of angles or torques and three of vectors.

    Raises:
        DataError: It cannot be read, or is not in this layout.
    """
    table = read_table(path, ["rowLabel"])
    first, second = ([name for name in table.columns if name.startswith(f"seg{k}_")] for k in (1, 2))
    if not first or len(first) != len(second) or len(table.cells) % ROWS != 1:
        raise DataError(f"{path}: holds no shapes of a rod in two halves, a line of stations and {ROWS} lines a shape")
    values = table.finite([*FIRST, *first, *second])
    shapes = values[1:].view(-1, 2, 3, values.shape[-1])
    turned, moved = (values.new_tensor(TO_ARM) @ shapes[:, part] for part in (0, 1))
    middle, tip = (torch.cat((turned[..., k], moved[..., k]), dim=-1) for k in (1, 2))
    places = moved[..., len(FIRST) :].mT.unflatten(1, (2, -1))
    return RodShapes(moved[..., 0], middle, tip, values[0, len(FIRST) : len(FIRST) + len(first)], places)
