"""A chain of arcs: frames and velocity columns of its tip, in the axes of the world.

The chain works on (..., n) arcs. A sensor inside section j of an arm is the tip of the chain whose later arcs have
length and bend zero, so a set of k sensors is just one more batch dimension, and nothing branches on where they are.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from apcc_torch.model.arc import Arc, arc_geometry


class Chain(NamedTuple):
    """Frames along a chain of arcs.

    arcs: the n arcs, each in its own base frame.
    before: (..., n, 3, 3) rotation of each arc's base frame.
    ends: (..., n, 3) position of each arc's tip, m.
    rotation: (..., 3, 3) rotation of the last tip.
    """

    arcs: Arc
    before: Tensor
    ends: Tensor
    rotation: Tensor

    @property
    def tip(self) -> Tensor:
        """(..., 3) position of the last tip, m."""
        return self.ends[..., -1, :]


def prefix_rotations(rotations: Tensor, base_rotation: Tensor) -> tuple[Tensor, Tensor]:
    """Products base R_1 ... R_{i-1} before each rotation, and the product of all.

    Args:
        rotations: (..., n, 3, 3).
        base_rotation: (3, 3).

    Returns:
        (..., n, 3, 3) and (..., 3, 3).
    """
    current = base_rotation.expand(*rotations.shape[:-3], 3, 3)
    before = []
    for rotation in rotations.unbind(-3):
        before.append(current)
        current = current @ rotation
    return torch.stack(before, dim=-3), current


def build_chain(x: Tensor, y: Tensor, length: Tensor, base_rotation: Tensor) -> Chain:
    """The chain of n arcs with bends (x, y) rad and lengths m, each (..., n). Eq. (3) [Dalenberg]."""
    arcs = arc_geometry(x, y)
    before, rotation = prefix_rotations(arcs.rotation, base_rotation)
    steps = (before @ (arcs.chord * length.unsqueeze(-1)).unsqueeze(-1)).squeeze(-1)
    return Chain(arcs, before, steps.cumsum(-2), rotation)


def flatten_columns(blocks: Tensor) -> Tensor:
    """(..., n, 3, c) blocks, one an arc, to one matrix (..., 3, n c)."""
    return blocks.transpose(-3, -2).flatten(-2)


def velocity_columns(chain: Chain, length: Tensor, fraction: Tensor | float) -> tuple[Tensor, Tensor]:
    """Angular and linear velocity of the chain's tip for unit rates of each section's (dx, dy, dL), in world axes.

    Args:
        chain: The chain; its arcs are `fraction` of their sections.
        length: (..., n) length of each arc, m.
        fraction: (..., n) part of each section that its arc covers: rates of the section's bend and length act on the
            arc with this weight.

    Returns:
        Angular (..., 3, 3 n), rad per (rad, rad, m), and linear (..., 3, 3 n), m per (rad, rad, m).
    """
    weight = fraction.unsqueeze(-1).unsqueeze(-1) if isinstance(fraction, Tensor) else fraction
    lever = length.unsqueeze(-1).unsqueeze(-1)
    arcs = chain.arcs
    local = torch.cat((arcs.spin, lever * arcs.bend, arcs.chord.unsqueeze(-1)), dim=-1) * weight
    world = chain.before @ local  # (..., n, 3, 5): spin x, y; bend x, y; chord
    spin = world[..., :2]
    arm = (chain.tip.unsqueeze(-2) - chain.ends).unsqueeze(-1)
    bend = world[..., 2:4] + torch.linalg.cross(spin, arm, dim=-2)
    linear = torch.cat((bend, world[..., 4:]), dim=-1)
    angular = torch.nn.functional.pad(spin, (0, 1))
    return flatten_columns(angular), flatten_columns(linear)
