"""What an arm should not touch: spheres, half-spaces and capsules, each a signed distance with its gradient."""

from __future__ import annotations

import torch
from torch import Tensor

from apcc_torch.errors import ValueRangeError
from apcc_torch.modes import holds
from apcc_torch.part import Part, hold_numbers, hold_rows
from apcc_torch.settings import Setting, aligned, check_setting
from apcc_torch.shapes import check_finite, check_tensor


class Obstacle(Part):
    """A body with a signed distance: negative inside."""

    def forward(self, p: Tensor) -> tuple[Tensor, Tensor]:
        """The distance (..., N), m, of points (..., N, 3) m, world frame, and its gradient (..., N, 3)."""
        raise NotImplementedError


class Capsule(Obstacle):
    """All points within `radius` of a line segment: a rod, a person's arm, a cable.

    Args:
        start: (..., 3) one end of the segment, m.
        end: (..., 3) its other end, m; the same as `start` for a sphere.
        radius: m, a number or (...) one a row.

    Raises:
        ValueRangeError: An end is not finite, or the radius is not positive.
    """

    start: Tensor
    end: Tensor
    radius: Setting

    def __init__(self, start: Tensor, end: Tensor, radius: Setting) -> None:
        super().__init__()
        ends = {"start": start, "end": end}
        held = {name: (check_finite(name, check_tensor(name, value, (3,))), 1) for name, value in ends.items()}
        hold_rows(self, **held)
        hold_numbers(self, radius=check_setting("radius", radius))

    def forward(self, p: Tensor) -> tuple[Tensor, Tensor]:
        """See `Obstacle`; on the segment itself the gradient is zero."""
        start, along = self.start.to(p).unsqueeze(-2), (self.end - self.start).to(p).unsqueeze(-2)
        length = along.square().sum(-1)
        share = ((p - start) * along).sum(-1) / torch.where(length > 0.0, length, 1.0)
        off = p - start - share.clamp(0.0, 1.0).unsqueeze(-1) * along
        distance, away = length_and_direction(off)
        return distance - aligned(self.radius, 1), away


class Sphere(Capsule):
    """A ball; see `Capsule`.

    Args:
        centre: (..., 3) m.
        radius: m, a number or (...) one a row.
    """

    def __init__(self, centre: Tensor, radius: Setting) -> None:
        super().__init__(centre, centre, radius)


class HalfSpace(Obstacle):
    """Everything behind a plane: a wall, a table.

    Args:
        point: (..., 3) a point of the plane, m.
        normal: (..., 3) direction that points out of the body; its length does not matter.

    Raises:
        ValueRangeError: A vector is not finite, or the normal is zero.
    """

    point: Tensor
    normal: Tensor

    def __init__(self, point: Tensor, normal: Tensor) -> None:
        super().__init__()
        check_finite("point", check_tensor("point", point, (3,)))
        check_finite("normal", check_tensor("normal", normal, (3,)))
        if not holds(normal.norm(dim=-1) > 0):
            raise ValueRangeError("normal must not be zero")
        hold_rows(self, point=(point, 1), normal=(normal, 1))

    def forward(self, p: Tensor) -> tuple[Tensor, Tensor]:
        """See `Obstacle`."""
        normal = (self.normal / self.normal.norm(dim=-1, keepdim=True)).to(p).unsqueeze(-2)
        distance = ((p - self.point.to(p).unsqueeze(-2)) * normal).sum(-1)
        return distance, normal.expand_as(p)


def length_and_direction(v: Tensor) -> tuple[Tensor, Tensor]:
    """|v| (...) and v / |v| (..., 3), both with zero derivatives where v is zero."""
    squared = v.square().sum(-1)
    nothing = squared == 0.0
    safe = torch.sqrt(torch.where(nothing, 1.0, squared))
    return torch.where(nothing, 0.0, safe), v / safe.unsqueeze(-1)
