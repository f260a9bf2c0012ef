"""A chain of short rods of constant strain: frames and velocity columns of its tip, in the axes of the world.

A rod moves its frame by exp(Omega), with the twist Omega = (omega, v) a polynomial of its section's coordinates a. With
A = J_l(omega) = c_1 I + c_2 hat(omega) + c_3 omega omega^T its tip is at u = A v, and

    spin    A domega                       angular velocity of its tip frame,
    reach   M domega + A dv                velocity of its tip,   M = d(A v)/d(omega),

per unit rate of each coordinate, in the frame at its base. With x = |omega|^2 and g_m = m c_{m+2} - c_{m+1}, a Stumpff
function c_m(x) changes by (omega . domega) g_m, and g_m by (omega . domega) h_m.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from apcc_torch.lie import so3
from apcc_torch.lie.stumpff import Stumpff, stumpff, stumpff_c7
from apcc_torch.model.chain import SecondOrder, assembled, flatten_columns, prefix_rotations
from apcc_torch.modes import full_precision


class Chosen(NamedTuple):
    """The n coordinates of q among all c of each section, one section after the other.

    places: (n,) int64 where each entry of q stands among all.
    entries: (sections c,) int64 which entry of q stands at each place; n where none does.
    """

    places: Tensor
    entries: Tensor


class Twists(NamedTuple):
    """What a model says of its rods; `sections` counts sections, `rods` the rods of one.

    twist: (..., sections, rods, 6) Omega, rad and m.
    directions: (..., sections, rods, 6, c) its derivatives with respect to the section's own coordinates a.
    curvature: (rods, 6, c, c) second derivatives, the same for every a; None where Omega is linear.
    part: (..., sections, c, c) derivative of a with respect to the section's coordinates in q; None for the identity.
    chosen: Which coordinates q has; None for all c of every section.
    """

    twist: Tensor
    directions: Tensor
    curvature: Tensor | None
    part: Tensor | None
    chosen: Chosen | None


class Drift(NamedTuple):
    """How the rods' tip frames move along qdot and accelerate at qddot = 0; each (..., m, 3), world axes.

    spin, spin_rate: Angular velocity and acceleration, rad/s and rad/s^2.
    acceleration: Of the tips, m/s^2.
    """

    spin: Tensor
    spin_rate: Tensor
    acceleration: Tensor


class StrainChain(NamedTuple):
    """Frames along a chain of rods; see `build_strain_chain`.

    twists: What it is made of.
    c: Stumpff functions (..., m, 1) of |omega|^2.
    before: (..., m, 3, 3) rotation of each rod's base frame, m rods in all.
    ends: (..., m, 3) position of each rod's tip, m.
    rotation: (..., 3, 3) rotation of the last tip.
    spin, reach: (..., m, 3, c) the columns of the module's head, in world axes.
    """

    twists: Twists
    c: Stumpff
    before: Tensor
    ends: Tensor
    rotation: Tensor
    spin: Tensor
    reach: Tensor

    @property
    def tip(self) -> Tensor:
        """(..., 3) position of the last tip, m."""
        return self.ends[..., -1, :]

    @property
    def tangents(self) -> Tensor:
        """(..., m, 3) z axes of the rods' tip frames."""
        return torch.cat((self.before[..., 1:, :, 2], self.rotation[..., None, :, 2]), dim=-2)

    def at(self, points: int | slice) -> StrainChain:
        """Of chains (..., k) to several points, the one to a point, or those to some of them; a point is the tip."""
        twists, rest = self.twists, [slice(None)] * 3
        chosen = twists._replace(
            twist=twists.twist[..., points, *rest],
            directions=twists.directions[..., points, *rest, slice(None)],
            part=None if twists.part is None else twists.part[..., points, *rest],
        )
        c = Stumpff(*(v[..., points, :, :] for v in self.c))
        before, spin, reach = (v[..., points, *rest] for v in (self.before, self.spin, self.reach))
        ends, rotation = (v[..., points, :, :] for v in (self.ends, self.rotation))
        return StrainChain(chosen, c, before, ends, rotation, spin, reach)

    @full_precision
    def tip_jacobian(self) -> Tensor:
        """Linear velocity (..., 3, n) of the tip, in world axes, for unit rates of the coordinates."""
        return self._gathered(self._linear(self.spin, self.reach))

    @full_precision
    def body_jacobian(self) -> Tensor:
        """Body twist (..., 6, n) of the tip for unit rates of the coordinates, rows angular then linear."""
        return self._gathered(self._body_columns())

    @full_precision
    def second_order(self, gradient: Tensor, slope: Tensor) -> SecondOrder:
        """See `SecondOrder`, by all c coordinates a of every section; arguments as `KinematicModel.second_order`."""
        shape, columns = self.twists.twist.shape[-3:-1], self._body_columns()
        turn, pull = (self.rotation.unsqueeze(-3) @ gradient.unflatten(-1, (2, 3)).unsqueeze(-1)).unbind(-3)
        arm = (self.tip.unsqueeze(-2) - self.ends).unsqueeze(-1)
        pull = pull.unsqueeze(-3).expand_as(arm)
        swing = self.spin.mT @ torch.linalg.cross(self.reach, pull.expand_as(self.reach), dim=-2)
        # At each rod's own tip, in the axes of its base.
        turn = self.before.mT @ (turn.unsqueeze(-3) + torch.linalg.cross(arm, pull, dim=-2))
        pull = self.before.mT @ pull
        bent = []
        for along in torch.eye(columns.shape[-1], dtype=gradient.dtype, device=gradient.device):
            spin, reach = self._columns_rate(along.expand(*columns.shape[:-2], -1).unsqueeze(-1))
            bent.append(turn.mT @ spin + pull.mT @ reach)
        own = (0.5 * (torch.cat(bent, dim=-2) - swing)).unflatten(-3, shape)
        # Of two rods of one section the later one's velocity changes with the earlier one's coordinates no more.
        of_rods = columns.unflatten(-3, shape)
        before = of_rods.cumsum(-3) - 0.5 * of_rods
        half = (own + of_rods.mT @ slope[..., None, None, :, :] @ before).sum(-3)
        J = flatten_columns(of_rods.sum(-3))
        return SecondOrder((J.mT @ gradient.unsqueeze(-1)).squeeze(-1), assembled(J.mT @ slope @ J, half))

    def _body_columns(self) -> Tensor:
        """(..., m, 6, c) body twist of the tip for unit rates of the coordinates of each rod."""
        both = torch.cat((self.spin, self._linear(self.spin, self.reach)), dim=-1)
        angular, linear = (self.rotation.mT.unsqueeze(-3) @ both).split_with_sizes((both.shape[-1] // 2,) * 2, dim=-1)
        return torch.cat((angular, linear), dim=-2)

    @full_precision
    def jacobian_rate(self, qdot: Tensor) -> Tensor:
        """Jdot (..., 3, n) of the tip along qdot (..., n)."""
        along = self._own_rates(qdot).unsqueeze(-1)
        spin_rate, reach_rate = (self.before @ rate for rate in self._columns_rate(along))
        own = self.spin @ along
        omega = own.cumsum(-3) - own  # angular velocity of each rod's base frame
        spin_rate = spin_rate + torch.linalg.cross(omega, self.spin, dim=-2)
        reach_rate = reach_rate + torch.linalg.cross(omega, self.reach, dim=-2)
        starts = torch.nn.functional.pad(self.ends[..., :-1, :], (0, 0, 1, 0))
        step = (self.ends - starts).unsqueeze(-1)
        step_rate = self.reach @ along + torch.linalg.cross(omega, step, dim=-2)
        ends_rate = step_rate.cumsum(-3)
        arm_rate = ends_rate[..., -1:, :, :] - ends_rate
        return self._gathered(self._linear(spin_rate, reach_rate) + torch.linalg.cross(self.spin, arm_rate, dim=-2))

    @full_precision
    def drift(self, qdot: Tensor) -> Drift:
        """How the rods' tip frames move along qdot (..., n), and their accelerations at qddot = 0."""
        along = self._own_rates(qdot).unsqueeze(-1)
        turning, stepping = ((self.before @ (rate @ along)).squeeze(-1) for rate in self._columns_rate(along))
        own, step_rate = ((columns @ along).squeeze(-1) for columns in (self.spin, self.reach))
        spin = own.cumsum(-2)
        before = spin - own
        turn = turning + torch.linalg.cross(before, own)
        spin_rate = turn.cumsum(-2)
        step = self.ends - torch.nn.functional.pad(self.ends[..., :-1, :], (0, 0, 1, 0))
        swing = torch.linalg.cross(before, 2.0 * step_rate + torch.linalg.cross(before, step))
        swing = swing + torch.linalg.cross(spin_rate - turn, step)
        return Drift(spin, spin_rate, (stepping + swing).cumsum(-2))

    def _linear(self, spin: Tensor, reach: Tensor) -> Tensor:
        arm = (self.tip.unsqueeze(-2) - self.ends).unsqueeze(-1)
        return reach + torch.linalg.cross(spin, arm, dim=-2)

    def _gathered(self, columns: Tensor) -> Tensor:
        """Columns (..., m, r, c) of the rods to a matrix (..., r, n) for the coordinates of q."""
        twists = self.twists
        columns = columns.unflatten(-3, twists.twist.shape[-3:-1]).sum(-3)
        if twists.part is not None:
            columns = columns @ twists.part
        matrix = flatten_columns(columns)
        return matrix if twists.chosen is None else matrix.index_select(-1, twists.chosen.places)

    def _own_rates(self, qdot: Tensor) -> Tensor:
        """Rates (..., m, c) of the coordinates a of each rod's section."""
        twists = self.twists
        sections, rods, c = (twists.directions.shape[i] for i in (-4, -3, -1))
        rates = spread(qdot, twists.chosen, sections, c)
        if twists.part is not None:
            rates = (twists.part @ rates.unsqueeze(-1)).squeeze(-1)
        return rates.unsqueeze(-2).expand(*rates.shape[:-1], rods, c).flatten(-3, -2)

    def _columns_rate(self, along: Tensor) -> tuple[Tensor, Tensor]:
        """Rates (..., m, 3, c) of spin and reach in the frames at the rods' bases, along adot (..., m, c, 1)."""
        twists = self.twists
        w, v = twists.twist.flatten(-3, -2).split(3, dim=-1)
        directions = twists.directions.flatten(-4, -3)
        dw, dv = directions.split(3, dim=-2)
        wdot, vdot = (directions @ along).squeeze(-1).split(3, dim=-1)
        A, M = _left_jacobian(w, self.c), _reach_matrix(w, v, self.c)
        A_rate, M_rate = _rates(w, v, wdot, vdot, self.c)
        spin, reach = A_rate @ dw, M_rate @ dw + A_rate @ dv
        if twists.curvature is None:
            return spin, reach
        adot = along.squeeze(-1).unflatten(-2, twists.twist.shape[-3:-1])
        turning, stretching = (twists.curvature @ adot[..., None, :, None]).squeeze(-1).flatten(-4, -3).split(3, dim=-2)
        return spin + A @ turning, reach + M @ turning + A @ stretching


def spread(q: Tensor, chosen: Chosen | None, sections: int, c: int) -> Tensor:
    """Entries of q (..., n) as all c coordinates of each section (..., sections, c), zero for those q has not."""
    if chosen is not None:
        q = torch.nn.functional.pad(q, (0, 1)).index_select(-1, chosen.entries)
    return q.unflatten(-1, (sections, c))


def build_strain_chain(twists: Twists, base_rotation: Tensor) -> StrainChain:
    """The chain of all rods of all sections, from the base on."""
    w, v = twists.twist.flatten(-3, -2).split(3, dim=-1)
    c = stumpff(so3.squared_angle(w))
    dw, dv = twists.directions.flatten(-4, -3).split(3, dim=-2)
    A = _left_jacobian(w, c)
    before, rotation = prefix_rotations(so3.symmetric_plus_cross(w, c.c0, c.c1, c.c2), base_rotation)
    steps = (before @ (A @ v.unsqueeze(-1))).squeeze(-1)
    spin, reach = before @ (A @ dw), before @ (_reach_matrix(w, v, c) @ dw + A @ dv)
    return StrainChain(twists, c, before, steps.cumsum(-2), rotation, spin, reach)


def rod_poses(twist: Tensor) -> tuple[Tensor, Tensor]:
    """Rotations (..., 3, 3) and tips (..., 3), m, of rods of twist (..., 6), in the frames at their bases."""
    w, v = twist.split(3, dim=-1)
    c = stumpff(so3.squared_angle(w))
    tip = (_left_jacobian(w, c) @ v.unsqueeze(-1)).squeeze(-1)
    return so3.symmetric_plus_cross(w, c.c0, c.c1, c.c2), tip


def _left_jacobian(w: Tensor, c: Stumpff) -> Tensor:
    return so3.symmetric_plus_cross(w, c.c1, c.c2, c.c3)


def _outer(a: Tensor, b: Tensor) -> Tensor:
    return a.unsqueeze(-1) * b.unsqueeze(-2)


def _dot(a: Tensor, b: Tensor) -> Tensor:
    return (a * b).sum(-1, keepdim=True)


def _slopes(c: Stumpff) -> tuple[Tensor, Tensor, Tensor]:
    """g_1, g_2, g_3 of the module's head."""
    return c.c3 - c.c2, 2.0 * c.c4 - c.c3, 3.0 * c.c5 - c.c4


def _reach_matrix(w: Tensor, v: Tensor, c: Stumpff) -> Tensor:
    """M (..., 3, 3), the derivative of J_l(w) v with respect to w."""
    g1, g2, g3 = _slopes(c)
    along = _dot(w, v)
    g = g1 * v + g2 * torch.linalg.cross(w, v) + g3 * along * w
    turned = so3.symmetric_plus_cross(v, c.c3 * along, -c.c2, torch.zeros_like(along))
    return turned + _outer(g, w) + _outer(c.c3 * w, v)


def _rates(w: Tensor, v: Tensor, wdot: Tensor, vdot: Tensor, c: Stumpff) -> tuple[Tensor, Tensor]:
    """Rates (..., 3, 3) of A and M along (wdot, vdot)."""
    g1, g2, g3 = _slopes(c)
    p, along = _dot(w, wdot), _dot(w, v)
    along_rate = _dot(wdot, v) + _dot(w, vdot)
    turned = _outer(c.c3 * w, wdot)
    A_rate = so3.symmetric_plus_cross(w, p * g1, p * g2, p * g3) + so3.hat(c.c2 * wdot) + turned + turned.mT

    h1, h2 = 3.0 * (c.c5 - c.c4) + c.c3, 8.0 * c.c6 - 5.0 * c.c5 + c.c4
    h3 = 15.0 * stumpff_c7(so3.squared_angle(w), c.c5) - 7.0 * c.c6 + c.c5
    cross = torch.linalg.cross(w, v)
    g = g1 * v + g2 * cross + g3 * along * w
    g_rate = p * (h1 * v + h2 * cross + h3 * along * w) + g1 * vdot
    g_rate = g_rate + g2 * (torch.linalg.cross(wdot, v) + torch.linalg.cross(w, vdot))
    g_rate = g_rate + g3 * (along * wdot + along_rate * w)
    c2_rate, c3_rate = p * g2, p * g3
    zero = torch.zeros_like(p)
    M_rate = so3.symmetric_plus_cross(v, c3_rate * along + c.c3 * along_rate, -c2_rate, zero)
    M_rate = M_rate - so3.hat(c.c2 * vdot) + _outer(g_rate, w) + _outer(g, wdot)
    return A_rate, M_rate + _outer(c3_rate * w + c.c3 * wdot, v) + _outer(c.c3 * w, vdot)
