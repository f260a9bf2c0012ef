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

from apcc_torch.lie.stumpff import Stumpff, stumpff


class Arc(NamedTuple):
    """Geometry of an arc per unit length, in the frame at its base.

    rotation: (..., 3, 3) tip frame.
    columns: (..., 3, 5) spin, bend and chord side by side: what one product takes into other axes.
    """

    rotation: Tensor
    columns: Tensor

    @property
    def spin(self) -> Tensor:
        """(..., 3, 2) W: the tip frame turns with angular velocity W thetadot (base axes)."""
        return self.columns[..., :2]

    @property
    def bend(self) -> Tensor:
        """(..., 3, 2) U = du/dtheta."""
        return self.columns[..., 2:4]

    @property
    def chord(self) -> Tensor:
        """(..., 3) u: the tip is at L u."""
        return self.columns[..., 4]


class ArcRate(NamedTuple):
    """Time derivatives of an arc's geometry along thetadot.

    columns: (..., 3, 5) Wdot, Udot and udot = U thetadot side by side, as in `Arc`.
    """

    columns: Tensor

    @property
    def spin(self) -> Tensor:
        """(..., 3, 2) Wdot."""
        return self.columns[..., :2]

    @property
    def bend(self) -> Tensor:
        """(..., 3, 2) Udot."""
        return self.columns[..., 2:4]

    @property
    def chord(self) -> Tensor:
        """(..., 3) udot."""
        return self.columns[..., 4]


def squared_bend(x: Tensor, y: Tensor) -> Tensor:
    """D^2 = x^2 + y^2, rad^2, the argument of the Stumpff functions."""
    return torch.addcmul(x * x, y, y)


def arc_pose(x: Tensor, y: Tensor) -> tuple[Tensor, Tensor]:
    """Rotation R (..., 3, 3) and chord u (..., 3) of an arc bent by (x, y) rad; the tip is at L u. Eq. (1) [Dalenberg].

    Args:
        x: (...) Delta_x, rad.
        y: (...) Delta_y, rad.
    """
    c = stumpff(squared_bend(x, y))
    xb, yb, xa, ya = x * c.c2, y * c.c2, x * c.c1, y * c.c1
    return _rotation(x, y, xb, yb, xa, ya, c.c0), torch.stack((xb, yb, c.c1), dim=-1)


def _rotation(x: Tensor, y: Tensor, xb: Tensor, yb: Tensor, xa: Tensor, ya: Tensor, cos: Tensor) -> Tensor:
    xyb = -(x * yb)
    # Eq. (1) with the rotation transposed, so that it bends the way its translation does. On the diagonal stands
    # 1 - x^2 b = cos + y^2 b, since cos = 1 - D^2 b.
    across, along = torch.addcmul(cos, y, yb), torch.addcmul(cos, x, xb)
    return torch.stack((across, xyb, xa, xyb, along, ya, -xa, -ya, cos), dim=-1).unflatten(-1, (3, 3))


def arc_geometry(x: Tensor, y: Tensor, c: Stumpff | None = None) -> Arc:
    """The arc and its first derivatives; see `Arc`.

    W is the left Jacobian of SO(3) at omega = (-y, x, 0), applied to d(omega)/d(theta); it follows that
    W thetadot = (-ydot + c_3 x g, xdot + c_3 y g, c_2 g) with g = x ydot - y xdot.

    Args:
        x: (...) Delta_x, rad.
        y: (...) Delta_y, rad.
        c: Stumpff functions of `squared_bend`; None to compute them here.
    """
    c = stumpff(squared_bend(x, y)) if c is None else c
    xb, yb, xa, ya = x * c.c2, y * c.c2, x * c.c1, y * c.c1
    rotation = _rotation(x, y, xb, yb, xa, ya, c.c0)
    xc, yc = x * c.c3, y * c.c3
    xyc = x * yc
    # 1 - y^2 c_3 = c_1 + x^2 c_3, since c_1 = 1 - D^2 c_3.
    along_y, along_x = torch.addcmul(c.c1, x, xc), -torch.addcmul(c.c1, y, yc)
    # (1/D) d/dD of c_1 is c_3 - c_2, of c_2 is 2 c_4 - c_3.
    a1, b1 = c.c3 - c.c2, c.c4 - c.c3 + c.c4
    xb1, yb1 = x * b1, y * b1
    xyb1 = x * yb1
    rows = (
        (-xyc, along_x, torch.addcmul(c.c2, x, xb1), xyb1, xb),
        (along_y, xyc, xyb1, torch.addcmul(c.c2, y, yb1), yb),
        (-yb, xb, x * a1, y * a1, c.c1),
    )
    return Arc(rotation, _matrix(rows))


def _matrix(rows: tuple[tuple[Tensor, ...], ...]) -> Tensor:
    """Rows of entries (...) to a matrix (..., rows, columns)."""
    return torch.stack([entry for row in rows for entry in row], dim=-1).unflatten(-1, (len(rows), len(rows[0])))


def arc_rate(x: Tensor, y: Tensor, xdot: Tensor, ydot: Tensor, c: Stumpff | None = None) -> ArcRate:
    """Time derivatives of chord, spin and bend along (xdot, ydot) rad/s; see `ArcRate`.

    Args:
        x: (...) Delta_x, rad.
        y: (...) Delta_y, rad.
        xdot: (...) rad/s.
        ydot: (...) rad/s.
        c: Stumpff functions of `squared_bend`; None to compute them here.
    """
    c = stumpff(squared_bend(x, y)) if c is None else c
    xx, xy, yy = x * x, x * y, y * y
    xxdot, yydot = x * xdot, y * ydot
    p = xxdot + yydot  # D Ddot: the rate of any f(D) is p (1/D) df/dD
    xydot = torch.addcmul(xdot * y, x, ydot)
    xxdot, yydot = xxdot + xxdot, yydot + yydot
    a1, b1 = c.c3 - c.c2, c.c4 - c.c3 + c.c4
    # a' = a_1, b' = b_1, c_3' = 3 c_5 - c_4, a_1' = 3 c_5 - 3 c_4 + c_3 and b_1' = 8 c_6 - 5 c_5 + c_4.
    bdot = p * b1
    cdot = p * torch.sub(3.0 * c.c5, c.c4)
    a1dot = p * torch.add(c.c3, c.c5 - c.c4, alpha=3.0)
    b1dot = p * torch.add(torch.sub(c.c4, c.c5, alpha=5.0), c.c6, alpha=8.0)
    xb, yb, a = torch.addcmul(xdot * c.c2, x, bdot), torch.addcmul(ydot * c.c2, y, bdot), p * a1

    xyc = torch.addcmul(xydot * c.c3, xy, cdot)
    xxc = torch.addcmul(xxdot * c.c3, xx, cdot)
    yyc = torch.addcmul(yydot * c.c3, yy, cdot)
    xyb1 = torch.addcmul(xydot * b1, xy, b1dot)
    xxb1 = torch.addcmul(xxdot * b1, xx, b1dot)
    yyb1 = torch.addcmul(yydot * b1, yy, b1dot)
    xa1, ya1 = torch.addcmul(xdot * a1, x, a1dot), torch.addcmul(ydot * a1, y, a1dot)
    rows = (
        (-xyc, xxc, bdot + xxb1, xyb1, xb),
        (-yyc, xyc, xyb1, bdot + yyb1, yb),
        (-yb, xb, xa1, ya1, a),
    )
    return ArcRate(_matrix(rows))
