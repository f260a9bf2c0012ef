"""What the arm is asked to do: reach a point, track a moving one, take a shape."""

from __future__ import annotations

from typing import NamedTuple, Protocol

import torch
from torch import Tensor

from apcc_torch.control.step_io import Target
from apcc_torch.envs.arm import Arm
from apcc_torch.envs.backbone_points import backbone_points, powers
from apcc_torch.envs.streams import Stream

GOAL_BEND, GOAL_ELONGATION = 0.5, 0.02
"""Goals are taken from configurations of the row's own arm with bends and elongations up to this, rad and m."""

POSITION, DISTANCE, SPEED = 1.0, 2.0, 5.0
"""Bounds of observed positions (m), differences of positions (m) and velocities (m/s)."""


class Goal(NamedTuple):
    """What was drawn for each of N rows.

    points: (N, 6, 3) m, the middles and ends of the model's sections in the goal's configuration; the last is its tip.
    amplitude: (N, 3) m, omega: (N,) rad/s and phase: (N, 3) rad of the target's motion; None where it rests.
    """

    points: Tensor
    amplitude: Tensor | None = None
    omega: Tensor | None = None
    phase: Tensor | None = None


class Task(Protocol):
    """One task for N arms at once.

    scale: m, the error that costs 1 a step.
    tolerance: m, the error below which a step is a success.
    """

    scale: float
    tolerance: float

    def draw(self, stream: Stream, lengths: Tensor) -> tuple[Stream, Goal]:
        """The streams after the draws, and goals for arms with rest lengths (N, 3) m."""
        ...

    def target(self, goal: Goal, time: Tensor) -> Target:
        """Where the tip should be at time (N,) s."""
        ...

    def error(self, goal: Goal, time: Tensor, points: Tensor) -> Tensor:
        """(N,) m, from the true points."""
        ...

    def features(self, goal: Goal, time: Tensor, sensors: Tensor) -> Tensor:
        """(N, f) what is observed of the goal."""
        ...

    def bounds(self) -> list[float]:
        """f bounds of the features."""
        ...


class Reach:
    """The tip to a point that rests."""

    scale, tolerance = 0.1, 0.01

    def __init__(self, arm: Arm, like: Tensor) -> None:
        self.base, self.halves = arm.base(like), powers((0.5, 1.0), like)

    def draw(self, stream: Stream, lengths: Tensor) -> tuple[Stream, Goal]:
        """A configuration of the row's own arm, its bends and elongations uniform within their bounds."""
        stream, u = stream.uniform(3 * lengths.shape[-1], lengths.dtype)
        reach = (GOAL_BEND, GOAL_BEND, GOAL_ELONGATION) * lengths.shape[-1]
        q = (2.0 * u - 1.0) * lengths.new_tensor(reach)
        return stream, Goal(backbone_points(q, lengths, self.base, self.halves))

    def target(self, goal: Goal, time: Tensor) -> Target:
        """The goal's tip, at rest."""
        x_d = goal.points[:, -1]
        return Target(x_d, torch.zeros_like(x_d))

    def error(self, goal: Goal, time: Tensor, points: Tensor) -> Tensor:
        """Distance of the tip from the target."""
        return (self.target(goal, time).x_d - points[:, -1]).norm(dim=-1)

    def features(self, goal: Goal, time: Tensor, sensors: Tensor) -> Tensor:
        """The target, and the way there from the last sensor."""
        x_d = self.target(goal, time).x_d
        return torch.cat((x_d, x_d - sensors[:, -1]), dim=-1)

    def bounds(self) -> list[float]:
        """Three positions and three differences."""
        return [POSITION] * 3 + [DISTANCE] * 3


class Track(Reach):
    """The tip after a point that moves on a sine about its goal, Eq. (51) with a phase an axis."""

    amplitude, omega = (0.02, 0.08), (0.5, 2.0)

    def draw(self, stream: Stream, lengths: Tensor) -> tuple[Stream, Goal]:
        """A centre as `Reach` draws its point, then amplitudes, an angular frequency and phases."""
        stream, goal = super().draw(stream, lengths)
        stream, u = stream.uniform(7, lengths.dtype)
        low, high = self.amplitude
        # Up and down a third: the arm bends far more easily than it stretches.
        amplitude = (low + (high - low) * u[:, :3]) * lengths.new_tensor((1.0, 1.0, 1.0 / 3.0))
        slow, fast = self.omega
        return stream, goal._replace(
            amplitude=amplitude, omega=slow + (fast - slow) * u[:, 3], phase=2.0 * torch.pi * u[:, 4:]
        )

    def target(self, goal: Goal, time: Tensor) -> Target:
        """Eq. (51) and its rate."""
        assert goal.amplitude is not None and goal.omega is not None and goal.phase is not None  # drawn above
        omega = goal.omega.unsqueeze(-1)
        angle = omega * time.unsqueeze(-1) + goal.phase
        x_d = goal.points[:, -1] + goal.amplitude * torch.sin(angle)  # Eq. (51)
        return Target(x_d, omega * goal.amplitude * torch.cos(angle))

    def features(self, goal: Goal, time: Tensor, sensors: Tensor) -> Tensor:
        """The target, the way there, and the target's velocity."""
        target = self.target(goal, time)
        return torch.cat((target.x_d, target.x_d - sensors[:, -1], target.xdot_d), dim=-1)

    def bounds(self) -> list[float]:
        """Those of `Reach`, and three velocities."""
        return [*super().bounds(), *[SPEED] * 3]


class Shape(Reach):
    """The whole backbone onto the goal's."""

    scale, tolerance = 0.05, 0.01

    def error(self, goal: Goal, time: Tensor, points: Tensor) -> Tensor:
        """Mean distance of corresponding points, Eq. (52) with N = 6."""
        return (goal.points - points).norm(dim=-1).mean(-1)

    def features(self, goal: Goal, time: Tensor, sensors: Tensor) -> Tensor:
        """The goal's points, and the way there from every sensor."""
        ways = goal.points[:, 1::2] - sensors
        return torch.cat((goal.points.flatten(1), ways.flatten(1)), dim=-1)

    def bounds(self) -> list[float]:
        """Eighteen positions and nine differences."""
        return [POSITION] * 18 + [DISTANCE] * 9


TASKS = {"reach": Reach, "track": Track, "shape": Shape}
