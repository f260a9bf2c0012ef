"""Tasks: what points of the arm should do, and how fast each wants the arm to move because of it.

A task has an error e and asks for the velocity v = v_d + K e of something that moves with J qdot:

    what          rows   e                                       J
    position      3      x_d - x, m                              R J_b[3:], world axes
    orientation   3      log(R_d R^T), rad, world axes           R J_b[:3]
    direction     2      the shortest turn of the point's z      J_b[:2], the point's own x and y
    pose          6      orientation, then position              both

The parameter law learns from the tip's position alone: Eq. (5) does not depend on the rest lengths, so the regressor of
an orientation is zero. Remark 1 [Dalenberg].
"""

from __future__ import annotations

from collections.abc import Sequence
from math import pi
from typing import NamedTuple, Protocol

import torch
from torch import Tensor

from apcc_torch.control.gain import gain_matrix
from apcc_torch.errors import ValueRangeError
from apcc_torch.lie import so3
from apcc_torch.part import Part, hold_numbers, hold_rows
from apcc_torch.settings import Setting, check_setting
from apcc_torch.shapes import broadcast

ROWS = {"position": 3, "orientation": 3, "direction": 2, "pose": 6}
"""Rows of every kind of task."""


class TaskTarget(NamedTuple):
    """What a task should reach, in the world frame; only what the task's kind needs must be there.

    x_d: (..., 3) desired position, m, of "position" and "pose".
    xdot_d: (..., 3) its velocity, m/s; None for zero.
    R_d: (..., 3, 3) desired orientation, of "orientation" and "pose".
    omega_d: (..., 3) its angular velocity, rad/s, also of "direction"; None for zero.
    direction: (..., 3) unit vector along which the point's z axis, the backbone's tangent, should lie, of "direction".
    """

    x_d: Tensor | None = None
    xdot_d: Tensor | None = None
    R_d: Tensor | None = None
    omega_d: Tensor | None = None
    direction: Tensor | None = None


class TaskRate(NamedTuple):
    """What a task asks of qdot: J qdot should be v.

    J: (..., m, n).
    velocity: (..., m) v, rad/s in angular rows and m/s in linear ones.
    error: (..., m) e, rad and m.
    weight: (..., m) of the rows, in metres a radian where they are angular.
    """

    J: Tensor
    velocity: Tensor
    error: Tensor
    weight: Tensor


class JointedModel(Protocol):
    """An arm whose points have poses and body Jacobians: any `KinematicModel`, or `MountedArm` with its joints."""

    @property
    def n(self) -> int: ...

    def pose_and_body_jacobian(self, q: Tensor, L0: Tensor, X_tilde: Tensor, j: Tensor) -> tuple[Tensor, Tensor]: ...


class Task(Part):
    """One task of one point; see the module's head. Each number may also be a tensor (...), one a row.

    Args:
        what: "position", "orientation", "direction" or "pose".
        abscissa: Material abscissa of the point on the unstrained arm, m; None for the tip.
        gain: K, 1/s: a number, a diagonal or a matrix of 3 rows, for "pose" of 6 (angular first).
        weight: Of this task against others of its level.
        angular_weight: Metres that a radian counts as, against the metres of other rows and against the damping.
        level: Priority: lower levels first, higher ones only in what those leave free.

    Raises:
        ValueRangeError: An unknown kind, or a number is out of range.
        ShapeError: The gain has another size.
    """

    gain: Tensor
    weight: Setting
    angular_weight: Setting

    def __init__(
        self,
        what: str = "position",
        abscissa: float | None = None,
        gain: float | Tensor = 1.0,
        weight: Setting = 1.0,
        angular_weight: Setting = 0.1,
        level: int = 0,
    ) -> None:
        super().__init__()
        if what not in ROWS:
            raise ValueRangeError(f"what must be one of {', '.join(ROWS)}, got {what!r}")
        if abscissa is not None:
            check_setting("abscissa", abscissa)
        hold_rows(self, gain=(gain_matrix("gain", gain, 6 if what == "pose" else 3), 2))
        check_setting("weight", weight)
        check_setting("angular_weight", angular_weight)
        hold_numbers(self, weight=weight, angular_weight=angular_weight)
        self.what = what
        self.abscissa = abscissa
        self.level = level

    def forward(self, T: Tensor, J_b: Tensor, target: TaskTarget, seen: Tensor | None = None) -> TaskRate:
        """What the task asks for.

        Args:
            T: (..., 4, 4) the model's pose of the point, world frame.
            J_b: (..., 6, n) its body Jacobian, angular rows first.
            target: What to reach.
            seen: (..., 4, 4) the measured pose, where there is one; None to take the model's.

        Raises:
            ValueRangeError: The target lacks what this kind of task needs.
        """
        seen = T if seen is None else seen
        R = T[..., :3, :3]
        if self.what == "direction":
            return self._direction(R, J_b, target, seen)
        gain = self.gain.to(T)
        parts = []
        if self.what != "position":
            e = so3.log(self._need("R_d", target.R_d).to(T) @ seen[..., :3, :3].mT)
            parts.append((R @ J_b[..., :3, :], e, target.omega_d, self._angular(e)))
        if self.what != "orientation":
            e = self._need("x_d", target.x_d) - seen[..., :3, 3]
            parts.append((R @ J_b[..., 3:, :], e, target.xdot_d, self._filled(self.weight, e)))
        J = torch.cat([part[0] for part in parts], dim=-2)
        error = joined([part[1] for part in parts])
        ahead = joined([torch.zeros_like(e) if v is None else v.to(e) for _, e, v, _ in parts])
        velocity = ahead + (gain @ error.unsqueeze(-1)).squeeze(-1)
        return TaskRate(J, velocity, error, joined([part[3] for part in parts]))

    def _direction(self, R: Tensor, J_b: Tensor, target: TaskTarget, seen: Tensor) -> TaskRate:
        e = shortest_turn(seen[..., :3, :3], self._need("direction", target.direction))
        velocity = (self.gain.to(e) @ e.unsqueeze(-1)).squeeze(-1)
        if target.omega_d is not None:
            velocity = velocity + target.omega_d
        into_point = R.mT[..., :2, :]
        error = (into_point @ e.unsqueeze(-1)).squeeze(-1)
        velocity = (into_point @ velocity.unsqueeze(-1)).squeeze(-1)
        return TaskRate(J_b[..., :2, :], velocity, error, self._angular(error))

    def _need(self, name: str, value: Tensor | None) -> Tensor:
        if value is None:
            raise ValueRangeError(f"a task of kind {self.what} needs {name} in its target")
        return value

    def _angular(self, like: Tensor) -> Tensor:
        return self._filled(self.weight, like) * self._filled(self.angular_weight, like)

    @staticmethod
    def _filled(setting: Setting, like: Tensor) -> Tensor:
        """The setting on every row of like (..., m)."""
        if isinstance(setting, Tensor):
            return setting.to(like).unsqueeze(-1) * torch.ones_like(like)
        return torch.full_like(like, setting)


def joined(vectors: Sequence[Tensor]) -> Tensor:
    """Vectors (..., m_i) one after another (..., sum m_i); their leading dimensions broadcast."""
    batch = broadcast(*(vector.shape[:-1] for vector in vectors))
    return torch.cat([vector.expand(*batch, vector.shape[-1]) for vector in vectors], dim=-1)


def weighted_rows(rates: Sequence[TaskRate]) -> tuple[Tensor, Tensor]:
    """All rows of several tasks, each times its weight: J (..., m, n) and v (..., m, 1)."""
    weight = joined([rate.weight for rate in rates]).unsqueeze(-1)
    batch = broadcast(*(rate.J.shape[:-2] for rate in rates))
    J = torch.cat([rate.J.expand(*batch, *rate.J.shape[-2:]) for rate in rates], dim=-2)
    return weight * J, weight * joined([rate.velocity for rate in rates]).unsqueeze(-1)


def shortest_turn(R: Tensor, direction: Tensor) -> Tensor:
    """The rotation vector (..., 3), rad, world axes, that turns R's z axis onto a unit direction the short way.

    Opposite to it any axis is as short; then it is R's x axis.

    Args:
        R: (..., 3, 3).
        direction: (..., 3).
    """
    z, x = R[..., :, 2], R[..., :, 0]
    z, direction = torch.broadcast_tensors(z, direction)
    axis = torch.linalg.cross(z, direction, dim=-1)
    cosine = (z * direction).sum(-1, keepdim=True)
    squared = axis.square().sum(-1, keepdim=True)
    small = squared < 1e-12
    sine = torch.sqrt(torch.where(small, 1.0, squared))
    # angle / sine is 1 + sine^2 / 6 near no turn.
    scale = torch.where(small, 1.0 + squared / 6.0, torch.atan2(sine, cosine) / sine)
    return torch.where(small & (cosine < 0.0), pi * x, scale * axis)
