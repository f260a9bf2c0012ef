"""How an arm's strains scatter when nothing is known of the tensions that its tendons are under."""

from __future__ import annotations

import torch
from torch import Tensor

from apcc_torch.linalg import solve_spd
from apcc_torch.model.arm import Arm
from apcc_torch.spread import spread

BESIDE = 0.1
"""How far a strain may be from what any tensions make of it, over that of the section that they strain most."""
UNTOLD = 0.5
"""What the deviation of a strain must fall below to be told, over what it is before it is measured with its neighbours
known: with more, measurements tell less than three times as much as that."""


def tension_scatter(arm: Arm) -> Tensor:
    """How the tensions of an arm's tendons scatter beside each other (n_a,), the largest being one.

    A motor that sets a length takes its tendon in by as large a share of what it bends as others do, so a long tendon
    is stretched by more. Tensions and pressures that are set are alike.

    Example:
        >>> tension_scatter(Arm(lengths=[0.2, 0.2]))
        tensor([0.5000, 0.5000, 0.5000, 1.0000, 1.0000, 1.0000], dtype=torch.float64)
    """
    routing = arm.routing()
    reach = routing.anchors - routing.starts
    if arm.chambers is not None or arm.actuation.sets == "tension":
        return torch.ones_like(reach)
    tension = reach * spread("stiffness", arm.actuation.stiffness, arm.n_tendons).to(reach)
    return tension / tension.amax(-1, keepdim=True)


def tension_information(
    B: Tensor, stiffness: Tensor, refine: int, lengths: Tensor, tensions: Tensor | None = None
) -> Tensor:
    """Inverse covariance (..., n, n) of sections' strains under tensions that are independent.

    A tendon bends and shortens every section that it passes, so the strains of neighbours go together: c = F u with F
    the sum over a section's pieces of K^-1 B. Bends are given over the deviation of the section that is bent most,
    elongations over their section's length and then over the deviation of the one that is stretched most. Weight and
    load, which stretch all sections that are as stiff alike, do as much of that as tendons, and so does what is a
    section's own, by which it is longer than it is believed to be.

    Args:
        B: (..., n_f, n_a) actuation matrix of the arm's pieces.
        stiffness: (..., n_f) K of the pieces, N m/rad and N/m.
        refine: Pieces of a section.
        lengths: (..., n_p) of the pieces, m.
        tensions: (..., n_a) deviations, over each other, such as from `tension_scatter`; None where all are alike.

    Example:
        >>> arm = Arm(lengths=[0.2, 0.2], racks=[0.4])
        >>> B, K, L = arm.routing().matrix(arm.rest_lengths()), arm.dynamics().stiffness_diagonal, arm.rest_lengths()
        >>> scatter = torch.linalg.inv(tension_information(B, K, 1, L, tension_scatter(arm)))
        >>> scatter[0, [0, 3]].round(decimals=2)
        tensor([1.0100, 1.0000], dtype=torch.float64)
    """
    D = B if tensions is None else B * tensions.to(B).unsqueeze(-2)
    F = (D / stiffness.unsqueeze(-1)).unflatten(-2, (-1, refine, 3)).sum(-3)
    bends = torch.cat((F[..., :2, :], torch.zeros_like(F[..., 2:, :])), dim=-2).flatten(-3, -2)  # (..., 3 n_b, n_a)
    soft = stiffness.unflatten(-1, (-1, refine, 3))[..., 2].reciprocal().sum(-1)
    own = lengths.unflatten(-1, (-1, refine)).sum(-1)
    pulled, hung = (_outer(x / own.unsqueeze(-1)) for x in (F[..., 2, :], soft.unsqueeze(-1)))
    eye = torch.eye(bends.shape[-2], dtype=B.dtype, device=B.device)
    into = eye[2::3]
    stretch = _over_largest(_over_largest(pulled) + _over_largest(hung) + into @ into.mT)
    scatter = _over_largest(_outer(bends)) + into.mT @ stretch @ into + BESIDE**2 * eye
    return solve_spd(scatter, eye.expand_as(scatter))


def _outer(F: Tensor) -> Tensor:
    return F @ F.mT


def _over_largest(scatter: Tensor) -> Tensor:
    most = scatter.diagonal(dim1=-2, dim2=-1).amax(-1).clamp(min=torch.finfo(scatter.dtype).tiny)
    return scatter / most[..., None, None]


def untold(deviation: Tensor, information: Tensor) -> Tensor:
    """(...) bool, whether a section's strain is more what was believed before than what is measured.

    Args:
        deviation: (..., n) of the strains now, over those before anything is measured.
        information: (..., n, n) from `tension_information`; its diagonal tells how a strain scatters where all others
            are known, which takes out what a section has from its neighbours alone.

    Example:
        >>> untold(torch.tensor([[0.1, 0.1, 0.1], [0.1, 0.1, 0.9]]), torch.eye(3))
        tensor([False,  True])
    """
    return (deviation.square() * information.diagonal(dim1=-2, dim2=-1) > UNTOLD**2).any(-1)
