"""An arm at rest as it was built: bent without load, and drawn together by tendons that are taut from the start."""

from __future__ import annotations

import torch
from torch import Tensor

from apcc_torch.linalg import solve_spd
from apcc_torch.model.arm import Arm
from apcc_torch.model.table import table
from apcc_torch.spread import spread

STEPS = 40
"""Most steps of Newton's method; of a convex energy that is made of parabolas it ends after a few."""
SHARES = 0.5 ** torch.arange(12)
"""Of a step, the one that lowers the energy most is taken."""


def strain_at_rest(arm: Arm) -> Tensor:
    """Bends, rad, and elongations, m, of an arm's sections (..., n) where its inputs are zero, without its weight.

    The least of the elastic energy of arm and tendons, (q - q_rest)^T K (q - q_rest) + sum k max(s + B^T q, 0)^2,
    with the pre-stretch s and the stiffness k of the tendons; tendons whose tensions are set hold nothing, nor do
    chambers, at whose pressure of rest the arm is measured. Carries no gradient.

    Args:
        arm: Its rest bends, stiffness, tendons and their pre-stretch.

    Example:
        >>> from apcc_torch.model.arm_tendons import Actuation
        >>> taut = Arm(lengths=[0.2, 0.25]).changed(actuation=Actuation(pre_stretch=1e-3))
        >>> bool((strain_at_rest(taut)[2::3] < 0).all())
        True
    """
    with torch.no_grad():
        B = arm.routing().matrix(arm.rest_lengths())
        K = arm.dynamics().stiffness_diagonal.to(B)
        bends = table("rest_bend", arm.rest_bend, arm.n_sections, 2).to(B)
        rest = torch.nn.functional.pad(bends, (0, 1)).flatten(-2).expand_as(K)
        k = spread("stiffness", arm.actuation.stiffness, arm.n_tendons).to(B)
        s = spread("pre_stretch", arm.actuation.pre_stretch, arm.n_tendons).to(B)
        if arm.chambers is not None or arm.actuation.sets == "tension" or bool((s + rest @ B <= 0.0).all()):
            return rest
        shares, q = SHARES.to(B).unsqueeze(-1), rest.unsqueeze(-2)

        def stretch(q: Tensor) -> Tensor:
            return (s + q @ B).clamp(min=0.0)

        for _ in range(STEPS):
            pulled = stretch(q)
            slope = K.unsqueeze(-2) * (q - rest.unsqueeze(-2)) + (k * pulled) @ B.mT
            H = torch.diag_embed(K) + (B * (k * (pulled > 0.0))) @ B.mT
            trial = q - shares * solve_spd(H, slope.mT).mT
            elastic = (K.unsqueeze(-2) * (trial - rest.unsqueeze(-2)).square()).sum(-1)
            energy = elastic + (k * stretch(trial).square()).sum(-1)
            least = energy.argmin(-1)[..., None, None]
            q = torch.take_along_dim(trial, least.expand(*least.shape[:-1], trial.shape[-1]), dim=-2)
        return q.squeeze(-2)
