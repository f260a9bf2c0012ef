"""A chain of arcs: frames and velocity columns of its tip, in the axes of the world.

The chain works on (..., n) arcs. A sensor inside section j of an arm is the tip of the chain whose later arcs have
length and bend zero, so a set of k sensors is just one more batch dimension, and nothing branches on where they are.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from apcc_torch.lie.stumpff import Stumpff, stumpff
from apcc_torch.model.arc import Arc, arc_geometry, arc_rate, squared_bend
from apcc_torch.modes import full_precision


class SecondOrder(NamedTuple):
    """Derivatives of a function of a chain's tip frame, by the N coordinates of the chain's own arcs, whole or cut.

    gradient: (..., N).
    hessian: (..., N, N).
    """

    gradient: Tensor
    hessian: Tensor


class Chain(NamedTuple):
    """Frames along a chain of n arcs.

    Its coordinates are each section's (dx, dy, dL).

    x, y: (..., n) bends, rad, and length: (..., n) m, broadcast with each other.
    c: Stumpff functions (..., n) of the squared bends.
    arcs: the arcs, each in its own base frame.
    before: (..., n, 3, 3) rotation of each arc's base frame.
    ends: (..., n, 3) position of each arc's tip, m.
    rotation: (..., 3, 3) rotation of the last tip.
    fraction: (..., n) part of each section that its arc covers: rates of the section's bend and length act on the arc
        with this weight. None where arcs are whole sections.
    """

    x: Tensor
    y: Tensor
    length: Tensor
    c: Stumpff
    arcs: Arc
    before: Tensor
    ends: Tensor
    rotation: Tensor
    fraction: Tensor | None = None

    @property
    def tip(self) -> Tensor:
        """(..., 3) position of the last tip, m."""
        return self.ends[..., -1, :]

    def at(self, points: int | slice) -> Chain:
        """Of chains (..., k) to several points, the one to a point, or those to some of them; a point is the tip."""
        one = isinstance(points, int)
        vectors, matrices = (..., points, slice(None)), (..., points, *[slice(None)] * 3)
        c, arcs = Stumpff(*(v[vectors] for v in self.c)), Arc(*(v[matrices] for v in self.arcs))
        x, y, length = (v[vectors] for v in (self.x, self.y, self.length))
        ends, rotation = (v[..., points, :, :] for v in (self.ends, self.rotation))
        fraction = None if one or self.fraction is None else self.fraction[vectors]
        return Chain(x, y, length, c, arcs, self.before[matrices], ends, rotation, fraction)

    @full_precision
    def tip_jacobian(self) -> Tensor:
        """Linear velocity (..., 3, 3 n) of the tip, in world axes, for unit rates of the coordinates."""
        arm = self.tip.unsqueeze(-2) - self.ends
        return flatten_columns(_linear_columns(self.before @ self.arcs.columns, arm, self.length))

    @full_precision
    def body_jacobian(self) -> Tensor:
        """Body twist (..., 6, 3 n) of the tip for unit rates of the coordinates, rows angular then linear."""
        arcs = self.arcs.columns
        return self._body_jacobian(arcs if self.fraction is None else arcs * self.fraction[..., None, None])

    @full_precision
    def second_order(self, gradient: Tensor, slope: Tensor) -> SecondOrder:
        """See `SecondOrder`; arguments as `KinematicModel.second_order`."""
        J = self._body_jacobian(self.arcs.columns)
        turn, pull = (self.rotation.unsqueeze(-3) @ gradient.unflatten(-1, (2, 3)).unsqueeze(-1)).unbind(-3)
        arm = (self.tip.unsqueeze(-2) - self.ends).unsqueeze(-1)
        # At each arc's own tip, in the axes of its base.
        pull = pull.unsqueeze(-3).expand_as(arm)
        turn = self.before.mT @ (turn.unsqueeze(-3) + torch.linalg.cross(arm, pull, dim=-2))
        pull = self.before.mT @ pull
        stretched = self.length[..., None, None] * pull
        one, other = torch.eye(2, dtype=gradient.dtype, device=gradient.device).unbind(-1)
        x, y, *c = (value.unsqueeze(-1) for value in (self.x, self.y, *self.c))
        rate = arc_rate(x, y, one, other, Stumpff(*c)).columns
        felt = torch.cat((turn, turn, stretched, stretched, pull), dim=-1).unsqueeze(-3)
        spun, bent, chord = (rate * felt).sum(-2).split_with_sizes((2, 2, 1), dim=-1)
        spin, bend = self.arcs.spin, self.arcs.bend * self.length[..., None, None]
        reach = torch.cat((bend, self.arcs.chord.unsqueeze(-1)), dim=-1)
        swing = spin.mT @ torch.linalg.cross(reach, pull.expand_as(reach), dim=-2)
        own = torch.cat((spun + bent, chord), dim=-1) - swing
        own = torch.cat((own, torch.nn.functional.pad(chord.mT, (0, 1))), dim=-2)
        M = J.mT @ slope @ J
        half = 0.5 * (own + diagonal_blocks(M, own.shape[-1]))
        return SecondOrder((J.mT @ gradient.unsqueeze(-1)).squeeze(-1), assembled(M, half))

    def _body_jacobian(self, arcs: Tensor) -> Tensor:
        from_body = self.rotation
        columns = (from_body.mT.unsqueeze(-3) @ self.before) @ arcs
        arm = (self.tip.unsqueeze(-2) - self.ends) @ from_body
        linear = _linear_columns(columns, arm, self.length)
        angular = torch.nn.functional.pad(columns[..., :2], (0, 1))
        return flatten_columns(torch.cat((angular, linear), dim=-2))

    @full_precision
    def jacobian_rate(self, qdot: Tensor) -> Tensor:
        """Jdot (..., 3, 3 n) of the tip along qdot (..., 3 n). Its columns of delta L are the regressor Y, Eq. (8)."""
        xdot, ydot, lengthdot = (rate.expand_as(self.length) for rate in qdot.unflatten(-1, (-1, 3)).unbind(-1))
        rate = arc_rate(self.x, self.y, xdot, ydot, self.c)
        columns = self.before @ self.arcs.columns
        spin, reach = columns.split_with_sizes((2, 3), dim=-1)  # what turns; what moves: bend and chord
        omega = angular_velocity(spin, torch.stack((xdot, ydot), dim=-1)).unsqueeze(-1)
        turned = self.before @ rate.columns
        spin_rate = torch.linalg.cross(omega, spin, dim=-2) + turned[..., :2]
        reach_rate = torch.linalg.cross(omega, reach, dim=-2) + turned[..., 2:]

        # The steps L u turn and stretch; what lies beyond section i moves with the later steps only.
        L, Ldot = self.length[..., None, None], lengthdot[..., None, None]
        bend_rate, step_rate = torch.addcmul(Ldot * reach, L, reach_rate).split_with_sizes((2, 1), dim=-1)
        ends_rate = step_rate.cumsum(-3)
        arm = (self.tip.unsqueeze(-2) - self.ends).unsqueeze(-1)
        arm_rate = ends_rate[..., -1:, :, :] - ends_rate
        swing = torch.linalg.cross(spin_rate, arm, dim=-2) + torch.linalg.cross(spin, arm_rate, dim=-2)
        return flatten_columns(torch.cat((bend_rate + swing, reach_rate[..., 2:]), dim=-1))


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


def build_chain(x: Tensor, y: Tensor, length: Tensor, base_rotation: Tensor, fraction: Tensor | None = None) -> Chain:
    """The chain of n arcs with bends (x, y) rad and lengths m, each (..., n). Eq. (3) [Dalenberg].

    fraction as in `Chain`.
    """
    c = stumpff(squared_bend(x, y))
    arcs = arc_geometry(x, y, c)
    before, rotation = prefix_rotations(arcs.rotation, base_rotation)
    steps = (before @ (arcs.chord * length.unsqueeze(-1)).unsqueeze(-1)).squeeze(-1)
    return Chain(x, y, length, c, arcs, before, steps.cumsum(-2), rotation, fraction)


def flatten_columns(blocks: Tensor) -> Tensor:
    """(..., n, r, c) blocks, one an arc, to one matrix (..., r, n c)."""
    return blocks.transpose(-3, -2).flatten(-2)


def diagonal_blocks(M: Tensor, c: int) -> Tensor:
    """The blocks (..., n, c, c) on the diagonal of M (..., n c, n c)."""
    blocks = M.unflatten(-1, (-1, c)).unflatten(-3, (-1, c))  # (..., n, c, n, c)
    return blocks.diagonal(dim1=-4, dim2=-2).movedim(-1, -3)


def assembled(M: Tensor, half: Tensor) -> Tensor:
    """The symmetric matrix (..., n c, n c) whose blocks below the diagonal are those of M, for it is half + half^T.

    In its own axes a frame's velocity by the coordinates of section i changes with those of the sections before i no
    more: below the diagonal there is no term but M.

    Args:
        M: (..., n c, n c).
        half: (..., n, c, c) blocks on the diagonal whose sum with their transposes is that of the matrix.
    """
    n, c = half.shape[-3:-1]
    below = torch.ones(n, n, dtype=M.dtype, device=M.device).tril(-1)[:, None, :, None]
    own = torch.eye(n, dtype=M.dtype, device=M.device)[:, None, :, None]
    blocks = M.unflatten(-1, (n, c)).unflatten(-3, (n, c))
    lower = (below * blocks + own * half.unsqueeze(-2)).flatten(-4, -3).flatten(-2)
    return lower + lower.mT


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


def angular_velocity(spin: Tensor, thetadot: Tensor) -> Tensor:
    """(..., n, 3) angular velocity of each section's base frame: the sum over the sections before it."""
    own = (spin @ thetadot.unsqueeze(-1)).squeeze(-1)
    return own.cumsum(-2) - own
