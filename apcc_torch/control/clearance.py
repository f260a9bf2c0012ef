"""Clearance of an arm: a smooth cost of points near obstacles and near the arm's own other parts.

With d the distance of the arm's surface from a body, a the distance at which it begins to matter and s = a - d,

    c = sum of (max(0, s) / a)^2 / 2,

which has a continuous gradient. Followed downhill in the null space of the tasks it bends the arm around what it should
not touch; as a null space may be empty this is no guarantee, and `clearance` says what is left.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor, nn

from apcc_torch.control.obstacles import Obstacle, length_and_direction
from apcc_torch.control.tasks import JointedModel
from apcc_torch.errors import ValueRangeError
from apcc_torch.model.abscissae import decouple
from apcc_torch.part import Part, hold_numbers
from apcc_torch.settings import Setting, aligned, check_setting


class Clearance(NamedTuple):
    """How near an arm comes, per row.

    obstacles: (...) smallest distance of its surface from an obstacle, m, negative inside; infinite without obstacles.
    self: (...) smallest distance between parts of its surface, m; infinite where no two parts are compared.
    """

    obstacles: Tensor
    self: Tensor


class ClearanceCost(Part):
    """The cost of the module's head, its gradient, and the clearance itself.

    Args:
        obstacles: What not to touch, in the world frame.
        radius: Of the arm, m.
        activation: Distance a from which a body counts, m.
        points: How many points along the backbone are looked at, evenly in rest length; the first one, at the base,
            does not move and is left out.
        self_separation: Points count as other parts of the arm when this much of it, m at rest, lies between them;
            None for no look at the arm itself.
        gain: Downhill speed: `descent` is minus this times the gradient, 1/s for coordinates in rad and m.

    Raises:
        ValueRangeError: A setting is out of range, or there is nothing to look at.
    """

    radius: Setting
    activation: Setting
    gain: Setting

    def __init__(
        self,
        obstacles: Sequence[Obstacle] = (),
        radius: Setting = 0.03,
        activation: Setting = 0.05,
        points: int = 24,
        self_separation: float | None = None,
        gain: Setting = 1.0,
    ) -> None:
        super().__init__()
        if points < 2:
            raise ValueRangeError(f"points must be at least 2, got {points}")
        if not obstacles and self_separation is None:
            raise ValueRangeError("obstacles are none and self_separation is None: there is nothing to keep clear of")
        check_setting("radius", radius)
        check_setting("activation", activation)
        check_setting("gain", gain)
        if self_separation is not None:
            check_setting("self_separation", self_separation)
        hold_numbers(self, radius=radius, activation=activation, gain=gain)
        self.n_points = points
        self.self_separation = self_separation
        self.obstacles = nn.ModuleList(obstacles)

    def forward(self, model: JointedModel, q: Tensor, L0: Tensor) -> tuple[Tensor, Tensor]:
        """The cost (...) and its gradient (..., n) at q (..., n), for rest lengths L0 (..., n_b), m."""
        p, J, X = self._points(model, q, L0)
        cost = torch.zeros_like(p[..., 0, 0])
        force = torch.zeros_like(p)  # dc/dp
        for distance, away in self._of_obstacles(p):
            slope, value = self._hinge(distance, 1)
            cost = cost + value.sum(-1)
            force = force + slope.unsqueeze(-1) * away
        if self.self_separation is not None:
            distance, away = self._of_itself(p, X)
            slope, value = self._hinge(distance, 2)
            # Every pair is met twice, once from either side.
            cost = cost + 0.5 * value.sum((-1, -2))
            force = force + (slope.unsqueeze(-1) * away).sum(-2)
        return cost, (J.mT @ force.unsqueeze(-1)).sum(-3).squeeze(-1)

    def descent(self, model: JointedModel, q: Tensor, L0: Tensor) -> Tensor:
        """The velocity (..., n) that goes downhill."""
        return -aligned(self.gain, 1) * self(model, q, L0)[1]

    def clearance(self, model: JointedModel, q: Tensor, L0: Tensor) -> Clearance:
        """How near the arm comes at q (..., n)."""
        p, _, X = self._points(model, q, L0)
        none = torch.full_like(p[..., 0, 0], torch.inf)
        near = [distance.amin(-1) for distance, _ in self._of_obstacles(p)]
        outside = torch.stack(near).amin(0) if near else none
        own = none if self.self_separation is None else self._of_itself(p, X)[0].amin((-1, -2))
        return Clearance(outside, own)

    def _points(self, model: JointedModel, q: Tensor, L0: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Points (..., N, 3) m, their Jacobians (..., N, 3, n) in world axes, and their abscissae (..., N), m."""
        last = self.n_points - 1
        share = torch.arange(1, last + 1, dtype=L0.dtype, device=L0.device) / last
        X = share * L0.sum(-1, keepdim=True)
        T, J_b = model.pose_and_body_jacobian(q, L0, *decouple(X, L0))
        return T[..., :3, 3], T[..., :3, :3] @ J_b[..., 3:, :], X

    def _of_obstacles(self, p: Tensor) -> list[tuple[Tensor, Tensor]]:
        """Of every obstacle, the distance (..., N) of the arm's surface, and its gradient (..., N, 3)."""
        seen = [obstacle(p) for obstacle in self.obstacles]
        return [(distance - aligned(self.radius, 1), away) for distance, away in seen]

    def _of_itself(self, p: Tensor, X: Tensor) -> tuple[Tensor, Tensor]:
        """Distances (..., N, N) between surfaces, infinite for neighbours, and gradients (..., N, N, 3)."""
        assert self.self_separation is not None
        distance, away = length_and_direction(p.unsqueeze(-2) - p.unsqueeze(-3))
        apart = (X.unsqueeze(-1) - X.unsqueeze(-2)).abs() > self.self_separation
        return torch.where(apart, distance - 2.0 * aligned(self.radius, 2), torch.inf), away

    def _hinge(self, distance: Tensor, extra: int) -> tuple[Tensor, Tensor]:
        """dc/dd and c of distances with `extra` dimensions behind the batch's."""
        a = aligned(self.activation, extra)
        inside = ((a - distance) / a).clamp(min=0.0)
        return -inside / a, 0.5 * inside.square()
