"""pytorch-kinematics' rigid chain of the same sections, five joints each; the tests' oracle of the backbone, too."""

from __future__ import annotations

from collections.abc import Callable

import pytorch_kinematics as pk
import torch
from torch import Tensor

JOINTS = (("continuous", "0 0 1"), ("continuous", "0 1 0"), ("prismatic", "0 0 1"), ("continuous", "0 1 0"),
          ("continuous", "0 0 1"))  # fmt: skip


def rigid_chain(sections: int) -> pk.SerialChain:
    """The chain, from a URDF text."""
    links, joints = ['<link name="link0"/>'], []
    for k in range(5 * sections):
        kind, axis = JOINTS[k % 5]
        limit = '<limit lower="-9" upper="9" effort="9" velocity="9"/>' if kind == "prismatic" else ""
        links.append(f'<link name="link{k + 1}"/>')
        joints.append(
            f'<joint name="joint{k}" type="{kind}"><parent link="link{k}"/><child link="link{k + 1}"/>'
            f'<origin xyz="0 0 0" rpy="0 0 0"/><axis xyz="{axis}"/>{limit}</joint>'
        )
    text = f'<robot name="arm">{"".join(links + joints)}</robot>'
    return pk.build_serial_chain_from_urdf(text, f"link{5 * sections}").to(dtype=torch.float64)


def tip_and_jacobian(q: Tensor, L0: Tensor) -> Callable[[], object]:
    """A call of the chain's forward kinematics and Jacobian at q (R, 9)."""
    x, y, dL = q.unflatten(-1, (-1, 3)).unbind(-1)
    phi, half = torch.atan2(y, x), 0.5 * torch.hypot(x, y)
    chord = (L0 + dL) * torch.sin(half) / half
    joints = torch.stack((phi, half, chord, half, -phi), dim=-1).flatten(-2)
    chain = rigid_chain(L0.shape[-1])
    return lambda: (chain.forward_kinematics(joints).get_matrix(), chain.jacobian(joints))
