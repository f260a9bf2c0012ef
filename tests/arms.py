"""Random arms, and the arm of the kinematic simulation of section V-A [Dalenberg]."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from apcc_torch.model.backbone import HANGING
from laws import uniform

PI = torch.tensor([0.105, 0.255, 0.24], dtype=torch.float64)
"""True rest lengths of section V-A, m."""
PI_HAT = torch.tensor([0.12, 0.28, 0.27], dtype=torch.float64)
"""First estimates of section V-A, m."""
HANGING_BASE = torch.tensor(HANGING, dtype=torch.float64)


def rest_lengths(shape: Sequence[int], n_sections: int, dtype: torch.dtype, rng: torch.Generator) -> Tensor:
    """(*shape, n_sections) rest lengths, m."""
    return uniform((*shape, n_sections), 0.08, 0.3, dtype, rng)


def configurations(
    shape: Sequence[int],
    n_sections: int,
    dtype: torch.dtype,
    rng: torch.Generator,
    bend: float = 1.2,
    elongation: float = 0.01,
) -> Tensor:
    """(*shape, 3 n_sections): bends up to `bend` rad in each direction, elongations up to `elongation` m."""
    scale = torch.tensor([bend, bend, elongation], dtype=torch.float64)
    return (uniform((*shape, n_sections, 3), -1.0, 1.0, torch.float64, rng) * scale).to(dtype).flatten(-2)
