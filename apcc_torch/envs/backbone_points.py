"""Positions along many arms, fast: what every step of every environment needs."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from apcc_torch.envs.places import Places
from apcc_torch.model.inertia import base_frames, bending, rotate
from apcc_torch.model.kinematic_model import KinematicModel
from apcc_torch.part import Part


class Positions(NamedTuple):
    """Where N arms are, world frame, m.

    backbone: (N, 2 n_b, 3) the middle and the end of every section of the model; the last one is the tip.
    sensors: (N, k, 3).
    """

    backbone: Tensor
    sensors: Tensor


class BackbonePoints(Part):
    """The positions of chosen material points.

    Args:
        backbone: The middles and ends of the model's sections.
        sensors: Where the sensors are.
        parts: Equal sections of the arm for each of the model.
        base: (3, 3) arm base to world.
    """

    base: Tensor
    powers: Tensor
    backbone: Tensor
    sensors: Tensor

    def __init__(self, backbone: Places, sensors: Places, parts: int, base: Tensor) -> None:
        super().__init__()
        local, section = zip(*(_in_parts(each, parts) for each in (backbone, sensors)), strict=True)
        # The same shares are taken of every section, its end last; of the points that this gives, those asked for.
        shares = sorted({1.0, *torch.cat(local).tolist()})
        index = [
            at * len(shares) + torch.tensor([shares.index(share) for share in each.tolist()])
            for each, at in zip(local, section, strict=True)
        ]
        self.register_buffer("base", base)
        self.register_buffer("powers", powers(tuple(shares), base))
        self.register_buffer("backbone", index[0].to(base.device))
        self.register_buffer("sensors", index[1].to(base.device))
        self.whole = index[0].equal(torch.arange(len(shares) * parts * int(backbone.section.max() + 1)))

    def forward(self, q: Tensor, lengths: Tensor) -> Positions:
        """The positions on arms with configurations (N, 3 n) and rest lengths (N, n), m."""
        points = backbone_points(q, lengths, self.base, self.powers)
        return Positions(points if self.whole else points[:, self.backbone], points[:, self.sensors])


class ModelPoints(Part):
    """The same positions on arms of any model, which places them itself.

    Args:
        backbone, sensors, parts: See `BackbonePoints`.
        model: Of the arm, with all its parts.
    """

    share: Tensor
    section: Tensor

    def __init__(self, backbone: Places, sensors: Places, parts: int, model: KinematicModel) -> None:
        super().__init__()
        self.model = model
        shares, sections = zip(*(_in_parts(each, parts) for each in (backbone, sensors)), strict=True)
        self.many = len(shares[0])
        self.register_buffer("share", torch.cat(shares).to(model.base_rotation))
        self.register_buffer("section", torch.cat(sections).to(model.base_rotation.device))

    def forward(self, q: Tensor, lengths: Tensor) -> Positions:
        """The positions on arms with configurations (N, n) and rest lengths (N, n_t), m."""
        points = self.model.pose(q, lengths, self.share, self.section)[..., :3, 3]
        return Positions(points[:, : self.many], points[:, self.many :])


def _in_parts(at: Places, parts: int) -> tuple[Tensor, Tensor]:
    """Shares (P,), and indices (P,), of the sections that `at`'s sections are divided into."""
    along = at.share * parts
    part = (along.ceil() - 1.0).clamp(min=0.0)
    return (along - part).round(decimals=12), at.section * parts + part.to(torch.int64)


def powers(fractions: tuple[float, ...], like: Tensor) -> Tensor:
    """(6, K) powers of material fractions of a section, as `inertia.bending` wants them; the last fraction is 1."""
    s = torch.tensor(fractions, dtype=like.dtype, device=like.device)
    return torch.stack([s**k for k in range(1, 7)])


def backbone_points(q: Tensor, lengths: Tensor, base: Tensor, powers: Tensor) -> Tensor:
    """Material points at the same K fractions of every section, from base to tip, (N, K n, 3) m, world frame.

    The same positions as `PCCBackbone.pose`, in the layout of `inertia`, without what only Jacobians need.

    Args:
        q: (N, 3 n) configuration.
        lengths: (N, n) rest lengths, m.
        base: (3, 3) arm base to world.
        powers: (6, K) from `powers`.
    """
    bend = bending(q.mT.contiguous(), lengths.mT.contiguous(), powers)
    beta, alpha = bend.radial[:2]
    across = bend.length * beta
    local = torch.stack((across * bend.x, across * bend.y, bend.length * alpha))
    steps = rotate(base_frames(bend, base.unsqueeze(-1)), local)  # (3, K, n, N), from each section's base
    whole = steps[:, -1]
    points = steps + (whole.cumsum(1) - whole).unsqueeze(1)
    return points.permute(3, 2, 1, 0).flatten(1, 2)
