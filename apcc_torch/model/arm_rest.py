"""An arm at rest as it was built: bent without load, and drawn together by tendons that are taut from the start."""

from __future__ import annotations

import torch
from torch import Tensor

from apcc_torch.linalg import solve_spd
from apcc_torch.model.arm import Arm
from apcc_torch.model.table import table
from apcc_torch.spread import spread


def strain_at_rest(arm: Arm) -> Tensor:
    """Bends, rad, and elongations, m, of an arm's sections (..., n) where its inputs are zero, without its weight.

    A tendon with a pre-stretch s pulls with k (s + B^T q), so (K + B k B^T) q = K q_rest - B k s over the taut ones.

    Args:
        arm: Its rest bends, stiffness, tendons and their pre-stretch.

    Example:
        >>> taut = Arm(lengths=[0.2, 0.25]).changed(actuation=Actuation(pre_stretch=1e-3))
        >>> bool((strain_at_rest(taut)[2::3] < 0).all())
        True
    """
    lengths = arm.rest_lengths()
    B = arm.routing().matrix(lengths)
    axial, bending = (each.to(B) for each in arm.section_stiffness())
    K = torch.stack(torch.broadcast_tensors(bending, bending, axial), dim=-1).flatten(-2)
    bends = table("rest_bend", arm.rest_bend, arm.n_sections, 2).to(B)
    rest = torch.nn.functional.pad(bends, (0, 1)).flatten(-2)
    stretch = spread("pre_stretch", arm.actuation.pre_stretch, arm.n_tendons).to(B).clamp(min=0.0)
    pull = B * (spread("stiffness", arm.actuation.stiffness, arm.n_tendons).to(B) * (stretch > 0.0))
    drawn = K * rest - (pull @ stretch.unsqueeze(-1)).squeeze(-1)
    return solve_spd(torch.diag_embed(K.expand_as(drawn)) + pull @ B.mT, drawn.unsqueeze(-1)).squeeze(-1)
