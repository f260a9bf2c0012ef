"""A chain of arcs: frames and velocity columns of its tip, in the axes of the world.

The chain works on (..., n) arcs. A sensor inside section j of an arm is the tip of the chain whose later arcs have
length and bend zero, so a set of k sensors is just one more batch dimension, and nothing branches on where they are.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from apcc_torch.lie.stumpff import Stumpff, stumpff
from apcc_torch.model.arc import Arc, arc_geometry, squared_bend


class Chain(NamedTuple):
    """Frames along a chain of n arcs.

    x, y: (..., n) bends, rad, and length: (..., n) m, broadcast with each other.
    c: Stumpff functions (..., n) of the squared bends.
    arcs: the arcs, each in its own base frame.
    before: (..., n, 3, 3) rotation of each arc's base frame.
    ends: (..., n, 3) position of each arc's tip, m.
    rotation: (..., 3, 3) rotation of the last tip.
    """

    x: Tensor
    y: Tensor
    length: Tensor
    c: Stumpff
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
    c = stumpff(squared_bend(x, y))
    arcs = arc_geometry(x, y, c)
    before, rotation = prefix_rotations(arcs.rotation, base_rotation)
    steps = (before @ (arcs.chord * length.unsqueeze(-1)).unsqueeze(-1)).squeeze(-1)
    return Chain(x, y, length, c, arcs, before, steps.cumsum(-2), rotation)


def flatten_columns(blocks: Tensor) -> Tensor:
    """(..., n, r, c) blocks, one an arc, to one matrix (..., r, n c)."""
    return blocks.transpose(-3, -2).flatten(-2)


def last_chain(chain: Chain) -> Chain:
    """Of chains (..., k) to several points, the one to the last point."""
    c = Stumpff(*(value.select(-2, -1) for value in chain.c))
    arcs = Arc(*(value.select(-4, -1) for value in chain.arcs))
    x, y, length = (value.select(-2, -1) for value in chain[:3])
    before, ends, rotation = chain.before.select(-4, -1), chain.ends.select(-3, -1), chain.rotation.select(-3, -1)
    return Chain(x, y, length, c, arcs, before, ends, rotation)


def _linear_columns(columns: Tensor, arm: Tensor, length: Tensor) -> Tensor:
    """(..., n, 3, 3) linear velocity of the tip for unit rates of each section's (dx, dy, dL).

    Args:
        columns: (..., n, 3, 5) spin, bend and chord.
        arm: (..., n, 3) from each arc's tip to the chain's, m, in the same axes.
        length: (..., n) m.
    """
    spin, bend, chord = columns.split_with_sizes((2, 2, 1), dim=-1)
    swing = torch.linalg.cross(spin, arm.unsqueeze(-1), dim=-2)
    return torch.cat((torch.addcmul(swing, length[..., None, None], bend), chord), dim=-1)


def tip_jacobian(chain: Chain) -> Tensor:
    """Linear velocity (..., 3, 3 n) of the tip, in world axes, for unit rates of each arc's (dx, dy, dL)."""
    arm = chain.tip.unsqueeze(-2) - chain.ends
    return flatten_columns(_linear_columns(chain.before @ chain.arcs.columns, arm, chain.length))


def body_jacobian(chain: Chain, fraction: Tensor) -> Tensor:
    """Body twist (..., 6, 3 n) of the tip for unit rates of each section's (dx, dy, dL), rows angular then linear.

    Args:
        chain: The chain; its arcs are `fraction` of their sections.
        fraction: (..., n) part of each section that its arc covers: rates of the section's bend and length act on the
            arc with this weight.
    """
    from_body = chain.rotation
    columns = (from_body.mT.unsqueeze(-3) @ chain.before) @ (chain.arcs.columns * fraction[..., None, None])
    arm = (chain.tip.unsqueeze(-2) - chain.ends) @ from_body
    linear = _linear_columns(columns, arm, chain.length)
    angular = torch.nn.functional.pad(columns[..., :2], (0, 1))
    return flatten_columns(torch.cat((angular, linear), dim=-2))
