"""One constant-curvature section: the arc, its first derivatives and their rates, smooth through the straight pose.

An arc is bent by theta = (x, y) rad (x = Delta_x, y = Delta_y of the paper, d = 1) and has length L, m. Eq. (1) as
printed bends its rotation and its translation opposite ways; the translation is kept and the rotation transposed, so
the tangent dp/ds is R e_z everywhere. With D^2 = x^2 + y^2 and a = c_1, b = c_2 of `lie.stumpff`, Stumpff's functions:

    R = [[1 - x^2 b, -x y b, x a], [-x y b, 1 - y^2 b, y a], [-x a, -y a, 1 - D^2 b]],   t = L u,   u = (x b, y b, a).

A fraction s of the section is the arc of bend s theta and length s L.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from apcc_torch.lie.stumpff import stumpff


class Arc(NamedTuple):
    """Geometry of an arc per unit length, in the frame at its base.

    rotation: (..., 3, 3) tip frame.
    chord: (..., 3) u: the tip is at L u.
    spin: (..., 3, 2) W: the tip frame turns with angular velocity W thetadot (base axes).
    bend: (..., 3, 2) U = du/dtheta.
    """

    rotation: Tensor
    chord: Tensor
    spin: Tensor
    bend: Tensor


class ArcRate(NamedTuple):
    """Time derivatives of an arc's geometry along thetadot.

    chord: (..., 3) udot = U thetadot.
    spin: (..., 3, 2) Wdot.
    bend: (..., 3, 2) Udot.
    """

    chord: Tensor
    spin: Tensor
    bend: Tensor


def _columns(first: tuple[Tensor, ...], second: tuple[Tensor, ...]) -> Tensor:
    """Two columns of three entries each -> (..., 3, 2)."""
    flat = torch.stack((first[0], second[0], first[1], second[1], first[2], second[2]), dim=-1)
    return flat.unflatten(-1, (3, 2))


def arc_pose(x: Tensor, y: Tensor) -> tuple[Tensor, Tensor]:
    """Rotation R (..., 3, 3) and chord u (..., 3) of an arc bent by (x, y) rad; the tip is at L u. Eq. (1) [Dalenberg].

    Args:
        x: (...) Delta_x, rad.
        y: (...) Delta_y, rad.
    """
    c = stumpff(x * x + y * y)
    xb, yb, xa, ya = x * c.c2, y * c.c2, x * c.c1, y * c.c1
    rotation = _rotation(x, y, xb, yb, xa, ya, c.c0)
    return rotation, torch.stack((xb, yb, c.c1), dim=-1)


def _rotation(x: Tensor, y: Tensor, xb: Tensor, yb: Tensor, xa: Tensor, ya: Tensor, cos: Tensor) -> Tensor:
    xyb = -x * yb
    # Eq. (1) with the rotation transposed, so that it bends the way its translation does.
    entries = (1.0 - x * xb, xyb, xa, xyb, 1.0 - y * yb, ya, -xa, -ya, cos)
    return torch.stack(entries, dim=-1).unflatten(-1, (3, 3))


def arc_geometry(x: Tensor, y: Tensor) -> Arc:
    """The arc and its first derivatives; see `Arc`.

    W is the left Jacobian of SO(3) at omega = (-y, x, 0), applied to d(omega)/d(theta); it follows that
    W thetadot = (-ydot + c_3 x g, xdot + c_3 y g, c_2 g) with g = x ydot - y xdot.

    Args:
        x: (...) Delta_x, rad.
        y: (...) Delta_y, rad.
    """
    c = stumpff(x * x + y * y)
    xb, yb, xa, ya = x * c.c2, y * c.c2, x * c.c1, y * c.c1
    rotation = _rotation(x, y, xb, yb, xa, ya, c.c0)
    chord = torch.stack((xb, yb, c.c1), dim=-1)
    xc, yc = x * c.c3, y * c.c3
    xyc = x * yc
    spin = _columns((-xyc, 1.0 - y * yc, -yb), (x * xc - 1.0, xyc, xb))
    # (1/D) d/dD of c_1 is c_3 - c_2, of c_2 is 2 c_4 - c_3.
    a1, b1 = c.c3 - c.c2, 2.0 * c.c4 - c.c3
    xyb1 = x * y * b1
    bend = _columns((c.c2 + x * x * b1, xyb1, x * a1), (xyb1, c.c2 + y * y * b1, y * a1))
    return Arc(rotation, chord, spin, bend)


def arc_rate(x: Tensor, y: Tensor, xdot: Tensor, ydot: Tensor) -> ArcRate:
    """Time derivatives of chord, spin and bend along (xdot, ydot) rad/s; see `ArcRate`.

    Args:
        x: (...) Delta_x, rad.
        y: (...) Delta_y, rad.
        xdot: (...) rad/s.
        ydot: (...) rad/s.
    """
    c = stumpff(x * x + y * y)
    p = x * xdot + y * ydot  # D Ddot: the rate of any f(D) is p (1/D) df/dD
    a1, b1 = c.c3 - c.c2, 2.0 * c.c4 - c.c3
    bdot = p * b1
    cdot = p * (3.0 * c.c5 - c.c4)
    a1dot = p * (3.0 * c.c5 - 3.0 * c.c4 + c.c3)
    b1dot = p * (8.0 * c.c6 - 5.0 * c.c5 + c.c4)
    chord = torch.stack((xdot * c.c2 + x * bdot, ydot * c.c2 + y * bdot, p * a1), dim=-1)

    xydot = xdot * y + x * ydot
    xyc = xydot * c.c3 + x * y * cdot
    xxc = 2.0 * x * xdot * c.c3 + x * x * cdot
    yyc = 2.0 * y * ydot * c.c3 + y * y * cdot
    xb, yb = chord[..., 0], chord[..., 1]
    spin = _columns((-xyc, -yyc, -yb), (xxc, xyc, xb))

    xyb1 = xydot * b1 + x * y * b1dot
    xxb1 = 2.0 * x * xdot * b1 + x * x * b1dot
    yyb1 = 2.0 * y * ydot * b1 + y * y * b1dot
    bend = _columns((bdot + xxb1, xyb1, xdot * a1 + x * a1dot), (xyb1, bdot + yyb1, ydot * a1 + y * a1dot))
    return ArcRate(chord, spin, bend)
