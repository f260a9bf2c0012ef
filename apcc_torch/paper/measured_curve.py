"""The curve that stands for the true arm in drawings of an arm whose backbone is not known."""

from __future__ import annotations

import torch
from torch import Tensor


def measured_curve(base_rotation: Tensor, T: Tensor, samples: int = 20) -> Tensor:
    """Points (k samples, 3) m from the base through k sensors, in cubic pieces along the sensors' own axes.

    A piece is as fast as the arc with its chord between its end tangents is long: c h / sin h, h half their angle.

    Args:
        base_rotation: (3, 3) base of the arm in the world; the arm leaves the origin along its z axis.
        T: (k, 4, 4) sensor poses, world frame, m.
        samples: Points between two sensors.

    Example:
        >>> T = torch.eye(4).repeat(2, 1, 1)
        >>> T[:, 2, 3] = torch.tensor([0.2, 0.45])
        >>> measured_curve(torch.eye(3), T, samples=2)[:, 2]
        tensor([0.1000, 0.2000, 0.3250, 0.4500])
    """
    position = torch.nn.functional.pad(T[:, :3, 3], (0, 0, 1, 0))
    axis = torch.cat((base_rotation[:, 2].to(T).unsqueeze(0), T[:, :3, 2]))
    half = 0.5 * torch.acos((axis[:-1] * axis[1:]).sum(-1, keepdim=True).clamp(-1.0, 1.0))
    speed = position.diff(dim=0).norm(dim=-1, keepdim=True) / torch.sinc(half / torch.pi)
    ends = position[:-1], position[1:], speed * axis[:-1], speed * axis[1:]
    start, end, leave, arrive = (each.unsqueeze(1) for each in ends)
    u = torch.arange(1, samples + 1, dtype=T.dtype, device=T.device).unsqueeze(-1) / samples
    u2, u3 = u * u, u * u * u
    points = (2 * u3 - 3 * u2 + 1) * start + (u3 - 2 * u2 + u) * leave + (3 * u2 - 2 * u3) * end + (u3 - u2) * arrive
    return points.flatten(0, 1)
