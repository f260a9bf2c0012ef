"""How a section's strain lies along it where tendons end within the section, and so pull on a part of it alone."""

from __future__ import annotations

import torch
from torch import Tensor

from apcc_torch.modes import holds

ROUNDING = 1e-9
"""Over the largest strain of a piece, what of it is even."""
TOLD = 1e-2
"""Over the largest singular value, those from which tensions follow: of an arm that is stiff along itself, as most are
beside their bends, stretch tells none."""


def uneven_tension(B: Tensor, stiffness: Tensor, refine: int, lengths: Tensor) -> Tensor | None:
    """What a section's strain says of its pieces beyond an even share: U (..., n_f, n), None where all shares are even.

    Tensions u strain the pieces by D u = K^-1 B u, and the sections by F u, the sums over their pieces. The least
    tensions that make strains c are F^+ c, a stretch being weighed over its section's length. So the pieces depart from
    even shares by U c = P_0 D F^+ c, with P_0 taking away what all pieces of a section have in common.

    Args:
        B: (..., n_f, n_a) actuation matrix of the arm's pieces.
        stiffness: (..., n_f) K of the pieces, N m/rad and N/m.
        refine: Pieces of a section.
        lengths: (..., n_p) of the pieces, m.

    Example:
        >>> arm = Arm(lengths=[0.2], racks=[0.15])
        >>> B, K = arm.routing().matrix(arm.refined(2)), arm.dynamics(2).stiffness_diagonal
        >>> uneven_tension(B, K, 2, arm.refined(2))[[0, 3], 0].round(decimals=3)  # the second half bends half as far
        tensor([ 0.1670, -0.1670], dtype=torch.float64)
    """
    pieces = (B / stiffness.unsqueeze(-1)).unflatten(-2, (-1, refine, 3))  # (..., n_b, refine, 3, n_a)
    apart = (pieces - pieces.mean(-3, keepdim=True)).flatten(-4, -2)
    if holds(apart.abs() <= ROUNDING * pieces.abs().amax()):
        return None
    F = pieces.sum(-3).flatten(-3, -2)
    own = lengths.unflatten(-1, (-1, refine)).sum(-1)
    scale = torch.stack((torch.ones_like(own), torch.ones_like(own), own.reciprocal()), dim=-1).flatten(-2)
    least = torch.linalg.pinv(scale.unsqueeze(-1) * F, rtol=TOLD) * scale.unsqueeze(-2)
    return apart @ least
