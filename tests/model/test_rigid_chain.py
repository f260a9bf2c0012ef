"""The backbone against pytorch-kinematics: a section as a chain of five rigid joints.

An arc of length L bent by D in the plane at angle phi puts its tip where these joints put it: turn by phi about z, by
D / 2 about y, slide by the chord L sin(D/2) / (D/2) along z, turn by D / 2 about y, turn back by phi about z.
"""

from __future__ import annotations

import pytest
import pytorch_kinematics as pk
import torch
from peer_rigid_chain import rigid_chain
from torch import Tensor
from torch.func import jacfwd, vmap

from apcc_torch.model.abscissae import decouple
from apcc_torch.model.backbone import PCCBackbone
from arms import configurations, rest_lengths
from laws import generator


def joint_angles(q: Tensor, L0: Tensor, fraction: Tensor) -> Tensor:
    """Joint values (5 n,) of the part `fraction` (n,) of each section."""
    x, y, dL = q.unflatten(-1, (-1, 3)).unbind(-1)
    phi, half = torch.atan2(y, x), 0.5 * fraction * torch.hypot(x, y)
    chord = fraction * (L0 + dL) * torch.sin(half) / half
    return torch.stack((phi, half, chord, half, -phi), dim=-1).flatten(-2)


def world_jacobian(chain: pk.SerialChain, q: Tensor, L0: Tensor, fraction: Tensor) -> tuple[Tensor, Tensor]:
    """Angular and linear velocity (rows, 3, 3 n) of the chain's tip for unit rates of q."""
    joints = vmap(joint_angles)(q, L0, fraction)
    geometric = chain.jacobian(joints)  # linear, then angular, in the base frame
    by_q = geometric @ vmap(jacfwd(joint_angles))(q, L0, fraction)
    return by_q[:, 3:], by_q[:, :3]


@pytest.mark.parametrize("n", [1, 2, 3, 6])
def test_tip(n: int) -> None:
    rng = generator(n)
    chain, backbone = rigid_chain(n), PCCBackbone(n)
    q, L0 = configurations((20,), n, torch.float64, rng), rest_lengths((20,), n, torch.float64, rng)
    whole = torch.ones_like(L0)
    end = chain.forward_kinematics(vmap(joint_angles)(q, L0, whole)).get_matrix()
    tip = torch.tensor([1.0], dtype=torch.float64).expand(20, 1), torch.tensor([n - 1]).expand(20, 1)
    torch.testing.assert_close(backbone.pose(q, L0, *tip)[:, 0], end, rtol=0, atol=1e-12)
    _, linear = world_jacobian(chain, q, L0, whole)
    torch.testing.assert_close(backbone.tip_jacobian(q, L0), linear, rtol=0, atol=1e-12)


def test_material_points() -> None:
    rng = generator(5)
    chain, backbone = rigid_chain(3), PCCBackbone(3)
    q, L0 = configurations((10,), 3, torch.float64, rng), rest_lengths((10,), 3, torch.float64, rng)
    X = torch.linspace(0.02, 0.95, 5, dtype=torch.float64) * L0.sum(-1, keepdim=True)
    X_tilde, j = decouple(X, L0)
    pose, body = backbone.pose_and_body_jacobian(q, L0, X_tilde, j)
    for k in range(5):
        # The chain ends at the point: later sections have no extent. A tiny one, for the plane of none is not defined.
        fraction = (X_tilde[:, k, None] - (torch.arange(3) - j[:, k, None])).clamp(1e-300, 1.0)
        joints = vmap(joint_angles)(q, L0, fraction)
        end = chain.forward_kinematics(joints).get_matrix()
        torch.testing.assert_close(pose[:, k], end, rtol=0, atol=1e-12)
        angular, linear = world_jacobian(chain, q, L0, fraction)
        into_body = end[:, :3, :3].mT
        want = torch.cat((into_body @ angular, into_body @ linear), dim=-2)
        torch.testing.assert_close(body[:, k], want, rtol=0, atol=1e-11)
