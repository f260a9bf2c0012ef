"""What the arm is asked to do: reach a point, track a moving one, take a shape."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, NamedTuple

import torch
from torch import Tensor

from apcc_torch.control.step_io import Target
from apcc_torch.envs.backbone_points import BackbonePoints, Positions
from apcc_torch.envs.places import middles_and_ends, sensors_of
from apcc_torch.envs.randomisation import Range, check_range
from apcc_torch.envs.streams import Stream
from apcc_torch.model.arm import Arm
from apcc_torch.part import Part
from apcc_torch.settings import OURS, PAPER, Settings, resolved, setting

MOST_ELONGATION = 0.2
"""A goal's sections change their lengths by no more than this share of the shortest one's."""


class Goal(NamedTuple):
    """What was drawn for each of N rows.

    points: Where the goal's configuration has the arm; its tip is the target.
    amplitude: (N, 3) m, omega: (N,) rad/s and phase: (N, 3) rad of the target's motion; None where it rests.
    """

    points: Positions
    amplitude: Tensor | None = None
    omega: Tensor | None = None
    phase: Tensor | None = None


class Observed(NamedTuple):
    """How many numbers of each quantity a task observes: positions, their differences, and velocities."""

    positions: int
    differences: int
    velocities: int = 0


@dataclass(frozen=True, kw_only=True)
class ReachSettings(Settings):
    """Settings of `Reach`: goals are taken from configurations of the row's own arm."""

    goal_bend: float = setting(0.5, "rad", OURS, "largest bend of a goal", above=0)
    goal_elongation: float = setting(
        0.02, "m", OURS, "largest elongation of a goal; at most 0.2 of the shortest section", least=0
    )
    scale: float = setting(0.1, "m", OURS, "error that costs 1 a step", above=0)
    tolerance: float = setting(0.01, "m", OURS, "error below which a step is a success and pays 1", above=0)


@dataclass(frozen=True, kw_only=True)
class TrackSettings(ReachSettings):
    """Settings of `Track`."""

    amplitude: Range = setting((0.02, 0.08), "m", OURS, "range of the motion along x and y; a third along z", least=0)
    omega: Range = setting((0.5, 2.0), "rad/s", PAPER, "range of the motion's angular frequency", least=0)

    def check(self) -> None:
        """Raises ValueRangeError where a range is none."""
        super().check()
        check_range("amplitude", self.amplitude)
        check_range("omega", self.omega)


@dataclass(frozen=True, kw_only=True)
class ShapeSettings(ReachSettings):
    """Settings of `Shape`."""

    scale: float = setting(0.05, "m", OURS, "error that costs 1 a step", above=0)


class Reach(Part):
    """The tip to a point that rests.

    Args:
        arm: The arm.
        like: Dtype and device.
        *settings, **changes: See `ReachSettings`.
    """

    settings_type = ReachSettings

    reach: Tensor
    scale: float
    tolerance: float

    def __init__(self, arm: Arm, like: Tensor, *settings: Any, **changes: Any) -> None:
        super().__init__()
        s = resolved(type(self).settings_type, settings, changes)
        self.hold(s)
        assert isinstance(s, ReachSettings)  # every task's settings are
        stretch = min(s.goal_elongation, MOST_ELONGATION * float(arm.rest_lengths().min()))
        self.register_buffer("reach", like.new_tensor((s.goal_bend, s.goal_bend, stretch) * arm.n_sections))
        sensors, base = sensors_of(arm), arm.base_rotation().to(like)
        self.places = BackbonePoints(middles_and_ends(arm.n_sections), sensors, 1, base)
        self.n_points, self.n_sensors = 2 * arm.n_sections, len(sensors.share)

    def draw(self, stream: Stream, lengths: Tensor) -> tuple[Stream, Goal]:
        """The streams after the draws, and goals for arms with rest lengths (N, n_b) m.

        A goal is a configuration of the row's own arm, its bends and elongations uniform within their bounds.
        """
        stream, u = stream.uniform(3 * lengths.shape[-1], lengths.dtype)
        q = (2.0 * u - 1.0) * self.reach
        return stream, Goal(self.places(q, lengths))

    def target(self, goal: Goal, time: Tensor) -> Target:
        """Where the tip should be at time (N,) s: the goal's tip, at rest."""
        x_d = goal.points.backbone[:, -1]
        return Target(x_d, torch.zeros_like(x_d))

    def drawn(self, goal: Goal, time: Tensor) -> Tensor:
        """What a picture of row 0 shows of the goal: a point (3,), or a backbone (G, 3), m."""
        return self.target(goal, time).x_d[0]

    def error(self, goal: Goal, time: Tensor, points: Positions) -> Tensor:
        """Distance (N,) m of the tip from the target."""
        return (self.target(goal, time).x_d - points.backbone[:, -1]).norm(dim=-1)

    def features(self, goal: Goal, time: Tensor, sensors: Tensor) -> Tensor:
        """What is observed of the goal (N, f): the target, and the way there from the last sensor.

        Args:
            goal: From `draw`.
            time: (N,) s.
            sensors: (N, k, 3) m, as read.
        """
        x_d = self.target(goal, time).x_d
        return torch.cat((x_d, x_d - sensors[:, -1]), dim=-1)

    def observed(self) -> Observed:
        """What `features` holds, in this order."""
        return Observed(3, 3)


class Track(Reach):
    """The tip after a point that moves on a sine about its goal, Eq. (51) with a phase an axis.

    Args:
        arm: The arm.
        like: Dtype and device.
        *settings, **changes: See `TrackSettings`.
    """

    settings_type = TrackSettings

    amplitude: Range
    omega: Range

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
        x_d = goal.points.backbone[:, -1] + goal.amplitude * torch.sin(angle)  # Eq. (51)
        return Target(x_d, omega * goal.amplitude * torch.cos(angle))

    def features(self, goal: Goal, time: Tensor, sensors: Tensor) -> Tensor:
        """The target, the way there, and the target's velocity."""
        target = self.target(goal, time)
        return torch.cat((target.x_d, target.x_d - sensors[:, -1], target.xdot_d), dim=-1)

    def observed(self) -> Observed:
        """See `Reach`."""
        return Observed(3, 3, 3)


class Shape(Reach):
    """The whole backbone onto the goal's.

    Args:
        arm: The arm.
        like: Dtype and device.
        *settings, **changes: See `ShapeSettings`.
    """

    settings_type = ShapeSettings

    def drawn(self, goal: Goal, time: Tensor) -> Tensor:
        """The goal's backbone."""
        return goal.points.backbone[0]

    def error(self, goal: Goal, time: Tensor, points: Positions) -> Tensor:
        """Mean distance of corresponding points, Eq. (52) with N = 2 n_b."""
        return (goal.points.backbone - points.backbone).norm(dim=-1).mean(-1)

    def features(self, goal: Goal, time: Tensor, sensors: Tensor) -> Tensor:
        """The goal's points, and the way there from every sensor."""
        ways = goal.points.sensors - sensors
        return torch.cat((goal.points.backbone.flatten(1), ways.flatten(1)), dim=-1)

    def observed(self) -> Observed:
        """See `Reach`."""
        return Observed(3 * self.n_points, 3 * self.n_sensors)
