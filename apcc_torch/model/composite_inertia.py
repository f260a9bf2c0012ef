"""The inertia matrix in its parts: composite sums over what each section carries, put together or solved as they are.

M(q) is full, but of few parts: the block of a section l and a section m < l that carries it is w_l^T t_m, with t_m the
twist of everything beyond m and w_l the momentum that a unit rate of section l gives to what it moves, both (6, 3). The
matrix is put together where somebody needs it; a long arm is solved from the parts, at a cost linear in its sections.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from apcc_torch.linalg import inverse_spd3, solve_spd
from apcc_torch.model.inertia import ArmShape, Bending, Moments, cross, rotate, sum_over

# The recursion over the sections takes one small operation after the other. It is faster than the matrix for this many
# sections and this many entries of the batch's matrices, and slower below.
RECURSIVE_SECTIONS = 12
RECURSIVE_ENTRIES = 9 * 30_000


class Composite(NamedTuple):
    """Parts of M(q), in the layout of `inertia`.

    moving: (6, 3, n_b, *batch) w, momentum about the world origin per unit of a section's own (dx, dy, dL).
    carrying: (6, 3, n_b, *batch) t, twist of everything beyond a section per unit of its (dx, dy, dL).
    diagonal: (3, 3, n_b, *batch) the sections' own blocks.
    """

    moving: Tensor
    carrying: Tensor
    diagonal: Tensor


def own_inertia(bend: Bending, sums: Moments) -> Tensor:
    """(9, n_b, *batch) inertia of a section in its own (dx, dy, dL), row by row."""
    x, y, length = bend.x, bend.y, bend.length
    square = length * length
    bb = square * sums.bb
    bent = square * (2.0 * sums.bb1 + sums.squares)
    mixed = length * (sums.bb + bend.square * sums.bb1 + sums.aa1)
    xy, xl, yl = x * y * bent, x * mixed, y * mixed
    return torch.stack((bb + x * x * bent, xy, xl, xy, bb + y * y * bent, yl, xl, yl, bend.square * sums.bb + sums.aa))


def composite(bend: Bending, shape: ArmShape, sums: Moments, before: Tensor) -> Composite:
    """Parts of M(q); see `Composite`.

    Args:
        bend: From `inertia.bending`.
        shape: From `inertia.arm_shape`, whose first five extra columns are `own_momentum`.
        sums: From `inertia.moments`.
        before: (n_b, n_b) strictly lower triangle of ones.
    """
    bases, length = shape.bases, bend.length
    linear, spin = shape.local[:, :3], shape.local[:, 3:5]
    first = length * linear[:, 2]  # first moment about the section's base
    # Second moment about the world origin, as a sum of outer products.
    z = shape.frames[:, 2]
    theta = bend.x * shape.frames[:, 0] + bend.y * shape.frames[:, 1]
    square = length * length
    bb, ab, aa = square * sums.bb, square * sums.ab, square * sums.aa
    whole = first + sums.mass * bases
    left = torch.stack((theta, z, bases, first), dim=1)
    right = torch.stack((bb * theta + ab * z, ab * theta + aa * z, whole, bases), dim=1)
    second = (left.unsqueeze(1) * right).sum(2)
    beyond = sum_over(before.mT, torch.cat((second.flatten(0, 1), whole, sums.mass.unsqueeze(0))))
    second, whole, mass = beyond[:9].unflatten(0, (3, 3)), beyond[9:12], beyond[12]

    angular, origin = shape.twists[:3, :2], shape.twists[3:]
    swing = cross(whole.unsqueeze(1), torch.cat((origin, angular), dim=1))
    trace = second[0, 0] + second[1, 1] + second[2, 2]
    turning = trace * angular - rotate(second, angular)
    carried_angular = torch.cat((swing[:, :2] + turning, swing[:, 2:3]), dim=1)
    push = mass * origin
    carried_linear = torch.cat((push[:, :2] - swing[:, 3:], push[:, 2:]), dim=1)
    carried = torch.cat((carried_angular, carried_linear), dim=0)

    arm = cross(bases.unsqueeze(1), linear)
    own = torch.cat((torch.cat((arm[:, :2] + spin, arm[:, 2:]), dim=1), linear), dim=0)
    diagonal = own_inertia(bend, sums) + (shape.twists.unsqueeze(2) * carried.unsqueeze(1)).sum(0).flatten(0, 1)
    return Composite(carried + own, shape.twists, diagonal.unflatten(0, (3, 3)))


def assembled(parts: Composite) -> Tensor:
    """M(q) as (*batch, 3 n_b, 3 n_b)."""
    n_b = parts.diagonal.shape[2]
    # Rows are the moving section l, columns the section m < l that carries it.
    moving = parts.moving.movedim((0, 2, 1), (-3, -2, -1)).flatten(-2)
    carrying = parts.carrying.movedim((0, 2, 1), (-3, -2, -1)).flatten(-2)
    blocks = moving.mT @ carrying
    own = parts.diagonal.movedim((0, 1, 2), (-3, -2, -1))
    blocks.unflatten(-1, (n_b, 3)).unflatten(-3, (n_b, 3)).diagonal(dim1=-4, dim2=-2).copy_(own)
    lower = torch.ones_like(blocks[(0,) * (blocks.dim() - 2)], dtype=torch.bool).tril()
    return torch.where(lower, blocks, blocks.mT)


def solved(parts: Composite, force: Tensor) -> Tensor:
    """M(q)^-1 force (*batch, 3 n_b); a row whose M is not positive definite is NaN.

    Args:
        parts: From `composite`.
        force: (*batch, 3 n_b).
    """
    n = force.shape[-1]
    # Compiled, small operations are cheap, and the batch may be of any size.
    if n >= 3 * RECURSIVE_SECTIONS and (torch.compiler.is_compiling() or force.numel() * n >= RECURSIVE_ENTRIES):
        return solved_recursively(parts, force)
    return solve_spd(assembled(parts), force.unsqueeze(-1)).squeeze(-1)


def solved_recursively(parts: Composite, force: Tensor) -> Tensor:
    """`solved` by block elimination from the tip to the base, the articulated-body recursion: linear in the sections.

    Without the sections beyond l, the remaining matrix has the same form with w_l - P t_l for w_l and
    D_l - t_l^T P t_l for its block, P the sum over the eliminated sections k of w_k D_k^-1 w_k^T, 6 x 6.
    """
    moving, carrying, own = (part.movedim((2, 0, 1), (0, -2, -1)) for part in parts)
    rest = force.unflatten(-1, (-1, 3)).movedim(-2, 0).unsqueeze(-1)
    P = torch.zeros_like(carrying[0] @ carrying[0].mT)
    g = torch.zeros_like(P[..., :1])
    eliminated: list[tuple[Tensor, Tensor]] = []
    for t, w, D, f in zip(carrying.flip(0), moving.flip(0), own.flip(0), rest.flip(0), strict=True):
        taken = P @ t
        w = w - taken
        inverse = inverse_spd3(D - t.mT @ taken)
        follows = w @ inverse
        f = f - t.mT @ g
        P = P + follows @ w.mT
        g = g + follows @ f
        eliminated.append((inverse @ f, follows))
    y = torch.zeros_like(g)
    solution = []
    for t, (free, follows) in zip(carrying, reversed(eliminated), strict=True):
        own_part = free - follows.mT @ y
        y = y + t @ own_part
        solution.append(own_part)
    return torch.stack(solution, dim=-3).squeeze(-1).flatten(-2)
