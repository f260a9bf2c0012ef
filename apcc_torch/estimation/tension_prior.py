"""How an arm's strains scatter when nothing is known of the tensions that its tendons are under."""

from __future__ import annotations

import torch
from torch import Tensor

from apcc_torch.linalg import solve_spd

BESIDE = 0.1
"""How far a bend may be from what any tensions make of it, over that of the section that tendons bend most."""
UNTOLD = 0.5
"""What the deviation of a strain must fall below to be told, over what it is before it is measured with its neighbours
known: with more, measurements tell less than three times as much as that."""


def tension_information(B: Tensor, stiffness: Tensor, refine: int) -> Tensor:
    """Inverse covariance (..., n, n) of sections' strains under tensions that are independent and alike.

    A tendon bends every section that it passes, so the bends of neighbours go together: c = F u with F the sum over a
    section's pieces of K^-1 B. They are given over the deviation of the section that is bent most. Elongations are
    independent, each of deviation one: weight and load change them as much as tendons do.

    Args:
        B: (..., n_f, n_a) actuation matrix of the arm's pieces.
        stiffness: (..., n_f) K of the pieces, N m/rad and N/m.
        refine: Pieces of a section.

    Example:
        >>> arm = Arm(lengths=[0.2, 0.2], racks=[0.4])
        >>> stiffness = arm.dynamics().stiffness_diagonal
        >>> scatter = torch.linalg.inv(tension_information(arm.routing().matrix(arm.rest_lengths()), stiffness, 1))
        >>> scatter[0, [0, 3]].round(decimals=2)
        tensor([1.0100, 1.0000], dtype=torch.float64)
    """
    F = (B / stiffness.unsqueeze(-1)).unflatten(-2, (-1, refine, 3)).sum(-3)  # (..., n_b, 3, n_a)
    bends = torch.cat((F[..., :2, :], torch.zeros_like(F[..., 2:, :])), dim=-2).flatten(-3, -2)
    scatter = bends @ bends.mT
    most = scatter.diagonal(dim1=-2, dim2=-1).amax(-1).clamp(min=torch.finfo(B.dtype).tiny)
    beside = B.new_tensor((BESIDE**2, BESIDE**2, 1.0)).repeat(F.shape[-3])
    eye = torch.eye(len(beside), dtype=B.dtype, device=B.device)
    return solve_spd(scatter / most[..., None, None] + torch.diag(beside), eye.expand_as(scatter))


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
