"""How the inverse Jacobian of SE(3) changes with its twist: what the second derivative of a logarithm is made of."""

from __future__ import annotations

import torch
from torch import Tensor
from torch.nn.functional import pad

from apcc_torch.lie import so3


def left_jacobian_inverse_slope(twist: Tensor, k: Tensor, dual: Tensor) -> Tensor:
    """The derivative (..., 6, 6) by the twist of J_l(twist)^-T dual; shapes are not checked here.

    With H, G and the blocks of `se3.left_jacobian_inverse_times`, f(W)^T z = z + H z + k H^2 z =: a(h; z), and the dual
    (z_1, z_2) becomes (a(h; z_1) + P(h; z_2) g, a(h; z_2)) with P = da/dh. Of x = |h|^2,
    dk/dx = ((1 - 3 k) / x + k^2) / 2.

    Args:
        twist: (..., 6) angular (rad), linear (m), of an angle below 2 pi.
        k: (..., 1) of its `so3.half_log`.
        dual: (..., 6) what a twist is multiplied with, angular part first.
    """
    h, g = (0.5 * twist).split_with_sizes((3, 3), dim=-1)
    z, both_h, both_k = dual.unflatten(-1, (2, 3)), h.unsqueeze(-2), k.unsqueeze(-2)
    slope, bend = _slopes(k, _dot(h, h))
    once = torch.linalg.cross(both_h, z)
    twice = torch.linalg.cross(both_h, once)
    inward = _dot(both_h, z)
    grown = 2.0 * slope.unsqueeze(-2) * twice - both_k * z
    identity = torch.eye(3, dtype=twist.dtype, device=twist.device)
    P = _outer(grown, both_h) - so3.hat(torch.addcmul(z, both_k, once)) + (both_k * inward).unsqueeze(-1) * identity
    P_1, P_2 = P.unbind(-3)

    # R = d(P(h; z_2) g)/dh
    (_, z), (_, once), (_, twice), (_, inward), (_, grown) = (v.unbind(-2) for v in (z, once, twice, inward, grown))
    along = 2.0 * _dot(h, g)
    by_h = 2.0 * slope * (inward * g - torch.linalg.cross(once, g) - along * z) + 2.0 * along * bend * twice
    R = _outer(by_h, h) + _outer(k * g, z) + _outer(grown - k * z, g) - so3.hat(along * slope * once)
    R = R + (k * _dot(g, z) + along * slope * inward).unsqueeze(-1) * identity

    derivative = torch.cat((torch.cat((P_1 + R, P_2), dim=-1), pad(P_2, (0, 3))), dim=-2)
    return 0.5 * derivative  # h and g are half the twist


def _slopes(k: Tensor, squared: Tensor) -> tuple[Tensor, Tensor]:
    """dk/dx and d^2k/dx^2 at x = squared (..., 1).

    What rounding leaves of the quotients meets as many factors h where they are used; the floor keeps them finite.
    """
    floor = squared.clamp(min=1e-12)
    quotient = torch.rsub(k, 1.0, alpha=3.0) / floor
    slope = 0.5 * torch.addcmul(quotient, k, k)
    return slope, torch.addcmul(-0.5 * (3.0 * slope + quotient) / floor, k, slope)


def _dot(a: Tensor, b: Tensor) -> Tensor:
    return (a * b).sum(-1, keepdim=True)


def _outer(a: Tensor, b: Tensor) -> Tensor:
    return a.unsqueeze(-1) * b.unsqueeze(-2)
