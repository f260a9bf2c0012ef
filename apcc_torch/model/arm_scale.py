"""How long, how strong and how stiff an arm is as a whole: what numbers that were chosen for one arm go with."""

from __future__ import annotations

import torch
from torch import Tensor

from apcc_torch.model.arm import Arm


def length(arm: Arm) -> float:
    """Its length, m."""
    return float(arm.rest_lengths().sum())


def largest_payload(arm: Arm) -> float:
    """The largest load at its tip that it is made for, kg."""
    return 0.5 * float(arm.section_masses().sum()) if arm.payload is None else float(arm.payload)


def tendon_stiffness(arm: Arm) -> float:
    """What a tendon's stiffness is weighed against, N/m: what bends a section, over what its tendons hold it with.

    Tendons act over their distance from the backbone. The section that needs most counts, and where there are fewer
    than three, each bends further under its load and is held more firmly.
    """
    bends = arm.routing().matrix(arm.rest_lengths()).unflatten(-2, (-1, 3))[:, :2]
    held = 0.5 * bends.square().sum((-2, -1))  # of a tendon stiffness of 1 N/m, N m/rad
    firmness = max(1.0, 3.0 / arm.n_sections) ** 2
    return firmness * float(torch.where(held > 0, _moments(arm) / held, 0.0).max())


def tendon_damping(arm: Arm) -> float:
    """What a tendon's damping is weighed against, N s/m: that stiffness over the arm's rate."""
    return tendon_stiffness(arm) / rate(arm)


def tendon_force(arm: Arm) -> float:
    """What a tendon's force is weighed against, N: that stiffness over the tendons' distance from the backbone."""
    return tendon_stiffness(arm) * float(arm.routing().offsets.mean())


def rate(arm: Arm) -> float:
    """How fast it swings about its base with its largest payload, rad/s."""
    lengths = arm.rest_lengths()
    middles = lengths.cumsum(-1) - 0.5 * lengths
    inertia = (
        arm.section_masses() @ (middles.square() + lengths.square() / 12.0) + largest_payload(arm) * length(arm) ** 2
    )
    return float((_moments(arm)[0] / inertia).sqrt())


def _moments(arm: Arm) -> Tensor:
    """What bends each section (n_b,), N m/rad: its own elasticity, and what lies beyond where it is held out level."""
    lengths = arm.rest_lengths()
    ends = lengths.cumsum(-1)
    begins, middles = ends - lengths, ends - 0.5 * lengths
    levers = (middles - begins.unsqueeze(-1)).clamp(min=0.0)  # (n_b, n_b), of section j about where i begins
    weight = levers @ arm.section_masses() + largest_payload(arm) * (ends[-1] - begins)
    return arm.section_stiffness()[1] + arm.placement.acceleration * weight
