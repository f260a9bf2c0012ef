"""Curvature of an arm at places along it, read off the pieces that a section is divided into."""

from __future__ import annotations

import torch
from torch import Tensor

from apcc_torch.model.abscissae import located
from apcc_torch.model.arm import Arm, vector
from apcc_torch.model.kinematic_model import KinematicModel
from apcc_torch.shapes import broadcast


def curvature_places(arm: Arm) -> Tensor | None:
    """(..., n_c) abscissae where an arm's curvature is measured, m; None where it is not."""
    return None if arm.curvature_sensors is None else vector(arm.curvature_sensors)


def middle_curvature(model: KinematicModel, q: Tensor, L0: Tensor) -> Tensor:
    """Curvature (..., n_b, 2) of the sections' middles as they are, 1/m: towards x and towards y of the axes there.

    Args:
        model: The arm.
        q: (..., n).
        L0: (..., n_b) m.

    Example:
        >>> model, q = PCCBackbone(1), torch.tensor([0.3, -0.1, 0.05]).double()
        >>> middle_curvature(model, q, torch.tensor([0.2]).double())
        tensor([[ 1.2000, -0.4000]], dtype=torch.float64)
    """
    sections = torch.arange(model.n_sections, device=q.device)
    batch = broadcast(q.shape[:-1], L0.shape[:-1])
    half = torch.full((*batch, model.n_sections), 0.5, dtype=q.dtype, device=q.device)
    L0 = L0.expand(*batch, model.n_sections)
    points = model.material_points(L0, half, sections.expand(half.shape))
    x, y, _, *linear = model.strain(q.expand(*batch, q.shape[-1]), L0, points).unbind(-1)
    length = torch.linalg.vector_norm(torch.stack(linear, dim=-1), dim=-1)
    return torch.stack((y / length, -x / length), dim=-1)


def curvature_weights(lengths: Tensor, refine: int, X: Tensor) -> Tensor:
    """(..., n_c, n_p) how much each piece's curvature counts at places along an arm of n_p pieces.

    Between the middles of a section's pieces, and on to its ends, curvature goes along a straight line. From section to
    section it may jump: a tendon that ends there bends what lies before it alone.

    Args:
        lengths: (..., n_p) rest lengths of the pieces, those of a section equal, m.
        refine: Pieces of a section.
        X: (..., n_c) abscissae on the arm at rest, m.

    Example:
        >>> curvature_weights(torch.tensor([0.1, 0.1]).double(), 2, torch.tensor([0.05, 0.1, 0.2]).double())
        tensor([[ 1.0000,  0.0000],
                [ 0.5000,  0.5000],
                [-0.5000,  1.5000]], dtype=torch.float64)
    """
    sections = lengths.unflatten(-1, (-1, refine)).sum(-1)
    batch = broadcast(X.shape[:-1], sections.shape[:-1])
    X_tilde, section = located(X.expand(*batch, X.shape[-1]), sections.expand(*batch, sections.shape[-1]))
    # In pieces, from the middle of the section's first one.
    along = X_tilde * refine - 0.5
    first = along.floor().clamp(0, max(refine - 2, 0)).long()
    second = first.add(1).clamp(max=refine - 1)
    part = torch.where(second > first, along - first, 0.0)
    pieces = torch.arange(lengths.shape[-1], device=lengths.device)
    begin = (section * refine).unsqueeze(-1)
    weights = torch.where(pieces == begin + first.unsqueeze(-1), 1.0 - part.unsqueeze(-1), 0.0)
    weights = weights + torch.where(pieces == begin + second.unsqueeze(-1), part.unsqueeze(-1), 0.0)
    return weights.to(lengths)
