"""A first guess of an arm's shape from its sensors' orientations, which no seed can mislead."""

from __future__ import annotations

import torch
from torch import Tensor

from apcc_torch.estimation.fit import Problem
from apcc_torch.lie import so3
from apcc_torch.model.kinematic_model import KinematicModel

# Of a section, the least part between sensors from which the bend of the whole is extrapolated.
LEAST_PART = 0.25


def measured_bends(backbone: KinematicModel, problem: Problem) -> Tensor:
    """q (..., n) of sections at rest length, bent as the turns from sensor to sensor say.

    The turn between an orientation that counts and the one before, at first the base's, is spread evenly over the
    material in between. It is right about the branch where no such turn exceeds half a turn, however far from the
    base's the last orientation is.
    """
    fraction, length = problem.points.fraction, problem.points.length
    before = backbone.base_rotation.to(fraction).expand_as(problem.rotation[..., 0, :, :])
    reached, at = torch.zeros_like(fraction[..., 0, :]), torch.zeros_like(length[..., 0, :])
    turn, part = torch.zeros_like(reached[..., None, :].expand(*reached.shape[:-1], 3, -1)), reached
    for i in range(problem.rotation.shape[-3]):
        counts = problem.oriented[..., i, None]
        rotation = torch.where(counts.unsqueeze(-1), problem.rotation[..., i, :, :], before)
        between = length[..., i, :] - at
        share = between / between.sum(-1, keepdim=True).clamp(min=torch.finfo(between.dtype).tiny)
        own = 2.0 * so3.half_log(before.mT @ rotation)[0].unsqueeze(-1) * share.unsqueeze(-2)
        turn = turn + own
        part = torch.where(counts, fraction[..., i, :], part)
        before, at = rotation, torch.where(counts, length[..., i, :], at)
    whole = turn / part.clamp(min=LEAST_PART).unsqueeze(-2)
    return backbone.coordinates.from_bends(whole[..., 1, :], -whole[..., 0, :])
