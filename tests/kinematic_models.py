"""The kinematic models that there are, with random arms of them: every model is tried by the same laws."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import torch
from torch import Tensor

from apcc_torch.model.affine import AffineBackbone
from apcc_torch.model.backbone import PCCBackbone
from apcc_torch.model.constant_strain import STRAINS, ConstantStrainBackbone
from apcc_torch.model.kinematic_model import KinematicModel
from arms import rest_lengths
from laws import generator, normal, rotations, uniform

Make = Callable[[int, Tensor | None], KinematicModel]


def mixed(n: int, base: Tensor | None = None) -> KinematicModel:
    """Sections that have different strains, in turn."""
    some = [("bend_x", "bend_y", "elongation"), ("bend_y", "torsion", "elongation"), tuple(STRAINS), ("elongation",)]
    return ConstantStrainBackbone(n, base, [some[i % 4] for i in range(n)])


MODELS: dict[str, Make] = {
    "pcc": PCCBackbone,
    "constant_strain": ConstantStrainBackbone,
    "torsion": lambda n, base=None: ConstantStrainBackbone(n, base, ("bend_x", "bend_y", "torsion", "elongation")),
    "mixed": mixed,
    "affine": AffineBackbone,
}
# How far, relative to 1 rad/m or 1, a model's frame is from moving along its strain: rods approximate affine curvature.
STRAIN_ERROR = {"affine": 2e-2}


def shapes_of(
    model: KinematicModel, shape: Sequence[int], dtype: torch.dtype, rng: torch.Generator, angle: float = 0.9
) -> Tensor:
    """(*shape, n) configurations: angles up to `angle` rad, lengths up to 0.01 m."""
    scale = model.coordinates.per_unit(angle, 0.01, model.n, torch.zeros((), dtype=torch.float64))
    return (uniform((*shape, model.n), -1.0, 1.0, torch.float64, rng) * scale).to(dtype)


def random_model(name: str, seed: int, n: int) -> tuple[KinematicModel, Tensor, Tensor]:
    """A model on a random base, q and L0."""
    rng = generator(seed)
    model = MODELS[name](n, rotations((), torch.float64, rng))
    return model, shapes_of(model, (), torch.float64, rng), rest_lengths((), n, torch.float64, rng)


def random_rows(name: str, seed: int, n: int, rows: int) -> tuple[KinematicModel, Tensor, Tensor, Tensor]:
    """A model on a random base, and so many q, L0 and qdot."""
    rng = generator(seed)
    model = MODELS[name](n, rotations((), torch.float64, rng))
    shape = (rows,)
    q, L0 = shapes_of(model, shape, torch.float64, rng), rest_lengths(shape, n, torch.float64, rng)
    return model, q, L0, normal((rows, model.n), torch.float64, rng)
