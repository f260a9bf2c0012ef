"""Mass points of a soft arm: where they are, how they move with q, and the composite sums that make up M(q).

Each section's mass sits at Gauss-Legendre nodes of its material fraction s and moves with the material. A section's
own sums are taken in the frame at its base, where bending is radial: with theta = (x, y, 0) a point lies at
L (beta theta + alpha z), beta = s^2 c_2 and alpha = s c_1 of (s D)^2, so every sum is a combination of a few moments
that depend on D^2 alone. Sections are joined in world axes about the world origin, where whatever happens to "all
sections beyond i" is a plain sum over them; only the product of the sections' rotations is sequential.

Layout: (component, section, *batch), batch last, so each operation runs over long contiguous rows. Twists are angular
first, then linear; the linear part is the velocity of the body point at the world origin.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from apcc_torch.lie.stumpff import Stumpff, stumpff


class Bending(NamedTuple):
    """The arm's coordinates and the radial functions of its points. K counts nodes; the last one is the section tip.

    x, y, length: (n_b, *batch) rad, rad, m.
    square: (n_b, *batch) D^2 = x^2 + y^2.
    stumpff: c_m of (s D)^2, each (K, n_b, *batch).
    radial: (4, K, n_b, *batch) beta, alpha and their derivatives (1/D) d/dD.
    """

    x: Tensor
    y: Tensor
    length: Tensor
    square: Tensor
    stumpff: Stumpff
    radial: Tensor


class ArmShape(NamedTuple):
    """World kinematics of the sections.

    frames: (3, 3, n_b, *batch) frame at the base of each section.
    bases, tips: (3, n_b, *batch) ends of each section, m.
    local: (3, C, n_b, *batch) world axes of the columns that were handed in.
    linear: (3, 3, n_b, *batch) derivative of each tip by its section's own (dx, dy, dL).
    twists: (6, 3, n_b, *batch) twist of everything beyond a section per unit of its (dx, dy, dL).
    """

    frames: Tensor
    bases: Tensor
    tips: Tensor
    local: Tensor
    linear: Tensor
    twists: Tensor


class Moments(NamedTuple):
    """Mass-weighted sums over a section's points, each (n_b, *batch), kg. b, a, b1, a1: beta, alpha and derivatives."""

    mass: Tensor
    b: Tensor
    a: Tensor
    b1: Tensor
    a1: Tensor
    bb: Tensor
    ab: Tensor
    aa: Tensor
    bb1: Tensor
    aa1: Tensor
    twirl: Tensor  # b a1 - a b1
    squares: Tensor  # D^2 b1 b1 + a1 a1


def quadrature_nodes(n: int, dtype: torch.dtype) -> tuple[Tensor, Tensor]:
    """Gauss-Legendre nodes on (0, 1) with the section tip (weight 0) appended.

    Args:
        n: Number of mass points per section.
        dtype: Floating-point type of the results.

    Returns:
        nodes (n + 1,) material fractions and weights (n + 1,) that sum to 1.
    """
    # Golub-Welsch: the nodes are the eigenvalues of the Legendre recurrence's Jacobi matrix. On the CPU, whatever the
    # default device is: it may be one without values.
    k = torch.arange(1, n, dtype=torch.float64, device="cpu")
    off = k / torch.sqrt(4.0 * k * k - 1.0)
    values, vectors = torch.linalg.eigh(torch.diag(off, 1) + torch.diag(off, -1))
    nodes = torch.cat((0.5 * (values + 1.0), torch.ones_like(k[:1])))
    weights = torch.cat((vectors[0] ** 2, torch.zeros_like(k[:1])))
    return nodes.to(dtype), weights.to(dtype)


def mass_points(n: int, like: Tensor) -> tuple[Tensor, Tensor]:
    """Powers s, s^2, ..., s^6 (6, n + 1) of `quadrature_nodes`, and their weights (n + 1,), of the kind of `like`."""
    nodes, weights = quadrature_nodes(n, torch.float64)
    return torch.stack([nodes**k for k in range(1, 7)]).to(like), weights.to(like)


def bending(q: Tensor, lengths: Tensor, powers: Tensor) -> Bending:
    """Radial functions of every point; see `Bending`.

    Args:
        q: (3 n_b, *batch) rad, rad, m.
        lengths: (n_b, *batch) rest lengths, m.
        powers: (6, K) s, s^2, ..., s^6 of the material fractions; the last column is the tip, s = 1.
    """
    x, y, stretch = q.unflatten(0, (-1, 3)).unbind(1)
    square = x * x + y * y
    s1, s2, s3, s4 = powers[:4].view(4, -1, *[1] * square.dim()).unbind(0)
    c = stumpff(square * s2)
    radial = torch.stack((s2 * c.c2, s1 * c.c1, s4 * (2.0 * c.c4 - c.c3), s3 * (c.c3 - c.c2)))
    return Bending(x, y, lengths + stretch, square, c, radial)


def moments(bend: Bending, point_masses: Tensor) -> Moments:
    """Sums over the points of each section; see `Moments`.

    Args:
        bend: From `bending`.
        point_masses: (K, n_b, *batch) kg.
    """
    weighted = bend.radial * point_masses
    b, a, b1, a1 = bend.radial.unbind(0)
    mb, ma, mb1, ma1 = weighted.unbind(0)
    products = torch.stack(
        (mb * b, mb * a, ma * a, mb * b1, ma * a1, mb * a1 - ma * b1, bend.square * (mb1 * b1) + ma1 * a1)
    )
    mass = point_masses.sum(0).expand_as(bend.square)
    return Moments(mass, *weighted.sum(1).unbind(0), *products.sum(1).unbind(0))


def base_frames(bend: Bending, base: Tensor) -> Tensor:
    """Frames at the section bases: base, base E_1, base E_1 E_2, ... with E the sections' rotations, Eq. (1)."""
    x, y = bend.x, bend.y
    c0, c1, c2 = bend.stumpff.c0[-1], bend.stumpff.c1[-1], bend.stumpff.c2[-1]
    xb, xa, ya = x * c2, x * c1, y * c1
    turn = -y * xb
    # Eq. (1) with the rotation transposed, as in `arc`.
    step = torch.stack((1.0 - x * xb, turn, xa, turn, 1.0 - y * y * c2, ya, -xa, -ya, c0)).unflatten(0, (3, 3))
    frames = [base.expand(step.shape[:2] + step.shape[3:])]
    for i in range(step.shape[2] - 1):
        frames.append((frames[-1].unsqueeze(2) * step[:, :, i]).sum(1))
    return torch.stack(frames, dim=2)


def rotate(frames: Tensor, columns: Tensor) -> Tensor:
    """(3, 3, n_b, *batch) applied to (3, C, n_b, *batch) columns."""
    a, b, c = frames.unsqueeze(2).unbind(1)
    x, y, z = columns.unbind(0)
    return torch.addcmul(torch.addcmul(a * x, b, y), c, z)


def cross(a: Tensor, b: Tensor) -> Tensor:
    """Cross product along the first dimension; several times faster than `torch.linalg.cross` in this layout."""
    a0, a1, a2 = a.unbind(0)
    b0, b1, b2 = b.unbind(0)
    return torch.stack(
        (
            torch.addcmul(a1 * b2, a2, b1, value=-1.0),
            torch.addcmul(a2 * b0, a0, b2, value=-1.0),
            torch.addcmul(a0 * b1, a1, b0, value=-1.0),
        )
    )


def arm_shape(bend: Bending, base: Tensor, extra: list[Tensor]) -> ArmShape:
    """Joins the sections in the world; see `ArmShape`.

    Args:
        bend: From `bending`.
        base: (3, 3, *batch) world rotation of the arm's base.
        extra: Components (n_b, *batch) of further columns in the section's base frame, three for each column.
    """
    x, y, length = bend.x, bend.y, bend.length
    c2, c3 = bend.stumpff.c2[-1], bend.stumpff.c3[-1]
    beta, alpha, beta1, alpha1 = bend.radial[:, -1].unbind(0)
    xx, yy, xy = x * x, y * y, x * y
    lb, lb1, la1 = length * beta, length * beta1, length * alpha1
    xyc, mixed = xy * c3, xy * lb1
    columns = [
        -xyc, 1.0 - yy * c3, -y * c2,
        xx * c3 - 1.0, xyc, x * c2,
        lb + xx * lb1, mixed, x * la1,
        mixed, lb + yy * lb1, y * la1,
        x * beta, y * beta, alpha,
    ]  # fmt: skip
    frames = base_frames(bend, base)
    stacked = torch.stack(columns + extra).unflatten(0, (-1, 3)).transpose(0, 1)
    world = rotate(frames, stacked)
    advance = length * world[:, 4]
    tips = torch.cumsum(advance, dim=1)
    spin, linear = world[:, :2], world[:, 2:5]
    swing = cross(tips.unsqueeze(1), spin)
    angular = torch.cat((spin, torch.zeros_like(linear[:, :1])), dim=1)
    origin = torch.cat((linear[:, :2] + swing, linear[:, 2:]), dim=1)
    twists = torch.cat((angular, origin), dim=0)
    return ArmShape(frames, tips - advance, tips, world[:, 5:], linear, twists)


def own_momentum(bend: Bending, sums: Moments) -> list[Tensor]:
    """A section's momentum per unit of its own (dx, dy, dL), base axes: three linear columns, then two angular ones.

    The angular momentum of the stretching column is zero: the points move along their radius.
    """
    x, y, length = bend.x, bend.y, bend.length
    lb, lb1, la1 = length * sums.b, length * sums.b1, length * sums.a1
    square = length * length
    mixed = x * y * lb1
    twirl, ab, bb = square * sums.twirl, square * sums.ab, square * sums.bb
    xt, yt = x * twirl, y * twirl
    return [
        lb + x * x * lb1, mixed, x * la1,
        mixed, lb + y * y * lb1, y * la1,
        x * sums.b, y * sums.b, sums.a,
        x * yt, ab - x * xt, -y * bb,
        y * yt - ab, -x * yt, x * bb,
    ]  # fmt: skip


def sum_over(weights: Tensor, values: Tensor) -> Tensor:
    """(n_b, n_b) weights applied over the section dimension of values (C, n_b, *batch)."""
    return (weights @ values.flatten(2)).reshape(values.shape) if values.dim() > 2 else values @ weights.mT
