"""What acts on an arm from outside: a payload, wrenches at the tip or anywhere, and a distributed load."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from apcc_torch.errors import ConfigError
from apcc_torch.model.inertia import ArmShape, cross, rotate, sum_over
from apcc_torch.shapes import check_tensor

Payload = Tensor | float | None


def front(value: Tensor, trailing: int, dims: int) -> Tensor:
    """Moves `trailing` last dimensions to the front and pads the batch to `dims`: the layout of `inertia`."""
    value = value.reshape((1,) * (dims - value.dim() + trailing) + value.shape)
    return value.movedim(tuple(range(-trailing, 0)), tuple(range(trailing))) if trailing else value


class Loads(NamedTuple):
    """External loads on an arm, in world axes.

    wrench: (..., 6) torque (N m) and force (N) at the tip.
    distributed: (..., 3) force per material length, N/m.
    section_wrenches: (..., n_b, 6) torque and force at every section's tip.
    places: (..., p) material abscissae, m; place_wrenches: (..., p, 6) torque and force there. Both, or neither.

    Raises:
        ConfigError: One of the last two is given without the other.

    Example:
        >>> pushed = Loads(wrench=torch.tensor([0.0, 0.0, 0.0, 0.1, 0.0, 0.0]).double())
        >>> equilibrium(Arm(lengths=[0.2, 0.25]).dynamics(), loads=pushed).q[:3]
        tensor([0.0214, 0.0000, 0.1526], dtype=torch.float64)
    """

    wrench: Tensor | None = None
    distributed: Tensor | None = None
    section_wrenches: Tensor | None = None
    places: Tensor | None = None
    place_wrenches: Tensor | None = None

    def checked(self, n_b: int) -> dict[str, tuple[Tensor, int]]:
        """The loads that are given, by name, with the number of their trailing dimensions."""
        if (self.places is None) != (self.place_wrenches is None):
            raise ConfigError("places and place_wrenches belong together: give both, or neither")
        p = None if self.places is None else check_tensor("places", self.places, (None,)).shape[-1]
        trailing: dict[str, tuple[int | None, ...]] = {
            "wrench": (6,), "distributed": (3,), "section_wrenches": (n_b, 6), "places": (p,), "place_wrenches": (p, 6)
        }  # fmt: skip
        return {
            name: (check_tensor(name, value, trailing[name]), len(trailing[name]))
            for name, value in self._asdict().items()
            if value is not None
        }


def distributed_load(shape: ArmShape, load: Tensor, share: Tensor) -> Tensor:
    """Forces (3, K, n_b, *batch) on the points, in the frames at the section bases, N.

    Args:
        shape: From `inertia.arm_shape`.
        load: (*batch, 3) force per material length, world axes, N/m.
        share: (K, n_b, *batch) material length of each point, m.
    """
    world = front(load, 1, shape.tips.dim() - 2).unsqueeze(1).unsqueeze(1)
    return rotate(shape.frames.transpose(0, 1), world) * share


def carried_wrench(shape: ArmShape, loads: Loads, before: Tensor) -> Tensor | None:
    """Torque and force (6, n_b or 1, *batch) about the world origin that each section's tip carries; None without any.

    Args:
        shape: From `inertia.arm_shape`.
        loads: What acts at the tip and at the sections' tips.
        before: (n_b, n_b) strictly lower triangle of ones.
    """
    dims = shape.tips.dim() - 2
    carried = None
    if loads.wrench is not None:
        carried = _about_origin(shape.tips[:, -1:], front(loads.wrench, 1, dims).unsqueeze(1))
    if loads.section_wrenches is not None:
        own = _about_origin(shape.tips, front(loads.section_wrenches, 2, dims).transpose(0, 1))
        beyond = own + sum_over(before.mT, own)
        carried = beyond if carried is None else carried + beyond
    return carried


def _about_origin(points: Tensor, wrench: Tensor) -> Tensor:
    torque, force = wrench.expand(6, *points.shape[1:]).split(3)
    return torch.cat((torque + cross(points, force), force))
