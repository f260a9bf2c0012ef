"""Accelerations that velocities alone cause, and the generalized forces of forces on an arm's mass points.

Layout as in `inertia`: (component, section, *batch).
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from apcc_torch.model.inertia import ArmShape, Bending, cross, rotate, sum_over


class Rates(NamedTuple):
    """Velocities of the coordinates and what follows from them.

    xdot, ydot, stretch: (n_b, *batch) rad/s, rad/s, m/s.
    p: (n_b, *batch) D Ddot. pdot: its rate at qddot = 0.
    columns: Six components (n_b, *batch): rate of the section's own angular velocity, and its tip's acceleration, both
        at qddot = 0 and in the frame at its base.
    curving: (2, K, n_b, *batch) second derivatives ((1/D) d/dD)^2 of beta and alpha.
    """

    xdot: Tensor
    ydot: Tensor
    stretch: Tensor
    p: Tensor
    pdot: Tensor
    columns: list[Tensor]
    curving: Tensor


def rates(bend: Bending, qdot: Tensor, powers: Tensor) -> Rates:
    """See `Rates`.

    Args:
        bend: From `inertia.bending`.
        qdot: (3 n_b, *batch) rad/s, rad/s, m/s.
        powers: (6, K) powers of the material fractions.
    """
    x, y, length = bend.x, bend.y, bend.length
    xdot, ydot, stretch = qdot.unflatten(0, (-1, 3)).unbind(1)
    p = x * xdot + y * ydot
    pdot = xdot * xdot + ydot * ydot
    c = bend.stumpff
    s5, s6 = powers[4:6].view(2, -1, *[1] * x.dim()).unbind(0)
    curving = torch.stack((s6 * (8.0 * c.c6 - 5.0 * c.c5 + c.c4), s5 * (3.0 * (c.c5 - c.c4) + c.c3)))

    beta, _, beta1, alpha1 = bend.radial[:, -1].unbind(0)
    beta2, alpha2 = curving[:, -1].unbind(0)
    # Second time derivative of L (x beta, y beta, alpha) at qddot = 0.
    lp = length * p
    mixed = 2.0 * stretch * p + length * pdot
    lpp = lp * p
    along_rate = 2.0 * (stretch * beta + lp * beta1)
    along_bend = mixed * beta1 + lpp * beta2
    # The section's own angular velocity is (-ydot + c_3 x g, xdot + c_3 y g, c_2 g), g = x ydot - y xdot constant.
    c3, c4, c5 = c.c3[-1], c.c4[-1], c.c5[-1]
    area = x * ydot - y * xdot
    c3dot = area * p * (3.0 * c5 - c4)
    c3area = area * c3
    columns = [
        c3dot * x + c3area * xdot,
        c3dot * y + c3area * ydot,
        area * p * (2.0 * c4 - c3),
        xdot * along_rate + x * along_bend,
        ydot * along_rate + y * along_bend,
        mixed * alpha1 + lpp * alpha2,
    ]
    return Rates(xdot, ydot, stretch, p, pdot, columns, curving)


def accelerations(
    bend: Bending, rate: Rates, shape: ArmShape, qdot: Tensor, before: Tensor, lift: Tensor | None
) -> Tensor:
    """Accelerations (3, K, n_b, *batch) of the points at qddot = 0, in the frames at the section bases, m/s^2.

    Args:
        bend: From `inertia.bending`.
        rate: From `rates`.
        shape: From `inertia.arm_shape`, whose last two extra columns are `rate.columns`.
        qdot: (3 n_b, *batch).
        before: (n_b, n_b) strictly lower triangle of ones: sums over the sections before each one.
        lift: () or (*batch) acceleration along world z that is added to every point (gravity), m/s^2.
    """
    own = qdot.unflatten(0, (-1, 3)).transpose(0, 1)
    twist = (shape.twists * own).sum(1)
    tip_velocity = (shape.linear * own).sum(1)
    wdot, drift = shape.local[:, -2], shape.local[:, -1]
    carried = sum_over(before, twist)
    w, v, omega, origin = twist[:3], twist[3:], carried[:3], carried[3:]
    # d/dt of a section's twist: the bracket with the twist that carries it, and its own rate about the world origin.
    turning = cross(
        torch.stack((omega, omega, origin, shape.tips, tip_velocity), 1), torch.stack((w, v, w, wdot, w), 1)
    )
    change = sum_over(before, torch.cat((turning[:, 0] + wdot, turning[:, 1:].sum(1) + drift)))
    omega_dot, origin_dot = change[:3], change[3:]
    # Acceleration of the material at the section's base: origin_dot + omega_dot x p + omega x (velocity at p).
    first = cross(torch.stack((omega, omega_dot), 1), shape.bases.unsqueeze(1))
    base = origin_dot + first[:, 1] + cross(omega, origin + first[:, 0])
    if lift is not None:
        base = torch.cat((base[:2], base[2:] + lift))
    local = rotate(shape.frames.transpose(0, 1), torch.stack((omega, omega_dot, base), 1))
    return _spread(bend, rate, local)


def _spread(bend: Bending, rate: Rates, local: Tensor) -> Tensor:
    """Accelerations of the points from omega, omega_dot and the base's acceleration, columns of local (3, 3, n_b)."""
    omega, omega_dot, base = local.unbind(1)
    length, p, stretch = bend.length, rate.p, rate.stretch
    zero = torch.zeros_like(p)
    theta = torch.stack((bend.x, bend.y, zero))
    theta_dot = torch.stack((rate.xdot, rate.ydot, zero))
    z = torch.stack((zero, zero, torch.ones_like(p)))
    # A point is beta u_1 + alpha u_2 with u_1 = L theta, u_2 = L z.
    arms = torch.stack((length * theta, length * z), 1)
    swing = cross(omega.unsqueeze(1), arms)
    velocity = torch.stack((stretch * theta + length * theta_dot, stretch * z), 1)
    twice = swing + 2.0 * velocity
    linear = cross(omega_dot.unsqueeze(1), arms) + cross(omega.unsqueeze(1), twice)
    mixed = 2.0 * stretch * p + length * rate.pdot
    bent = 2.0 * p * swing + torch.stack((mixed * theta + 2.0 * length * p * theta_dot, mixed * z), 1)
    curved = p * p * arms
    b, a, b1, a1 = bend.radial.unbind(0)
    b2, a2 = rate.curving.unbind(0)
    total = torch.addcmul(base.unsqueeze(1), b, (linear[:, 0] + 2.0 * stretch * theta_dot).unsqueeze(1))
    total = torch.addcmul(total, a, linear[:, 1:])
    total = torch.addcmul(total, b1, bent[:, :1])
    total = torch.addcmul(total, a1, bent[:, 1:])
    total = torch.addcmul(total, b2, curved[:, :1])
    return torch.addcmul(total, a2, curved[:, 1:])


def generalized_force(
    bend: Bending, shape: ArmShape, forces: Tensor, before: Tensor, outside: Tensor | None = None
) -> Tensor:
    """(*batch, 3 n_b) generalized force of forces on the points.

    Args:
        bend: From `inertia.bending`.
        shape: From `inertia.arm_shape`.
        forces: (3, K, n_b, *batch) force on each point, in the frame at its section's base, N.
        before: (n_b, n_b) strictly lower triangle of ones.
        outside: (6, n_b or 1, *batch) further torque and force about the world origin that each section's tip carries.
    """
    total = forces.sum(1)
    radial = (forces.unsqueeze(1) * bend.radial).sum(2)
    x, y, length = bend.x, bend.y, bend.length
    b, a, b1, a1 = radial.unbind(1)
    along = x * b1[0] + y * b1[1] + a1[2]
    own = torch.stack((length * (b[0] + x * along), length * (b[1] + y * along), x * b[0] + y * b[1] + a[2]), 1)
    # Torque about the section's base: L (theta x b + z x a).
    torque = length * torch.stack((y * b[2] - a[1], a[0] - x * b[2], x * b[1] - y * b[0]))
    world = rotate(shape.frames, torch.stack((torque, total), 1))
    force = world[:, 1]
    wrench = torch.cat((world[:, 0] + cross(shape.bases, force), force))
    carried = sum_over(before.mT, wrench)
    if outside is not None:
        carried = carried + outside
    own = own + (shape.twists * carried.unsqueeze(1)).sum(0).transpose(0, 1)
    return own.flatten(0, 1).movedim(0, -1)
