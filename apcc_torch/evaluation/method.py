"""What every method of the leaderboard is: it learns from one part of a recording and answers tasks on another."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import cached_property
from typing import ClassVar

import torch
from torch import Tensor

from apcc_torch.estimation.rest_calibration import RestCalibration
from apcc_torch.evaluation.frames import Frames
from apcc_torch.evaluation.tasks import Task
from apcc_torch.identification.fit import Fit, FitSettings
from apcc_torch.identification.parameters import Parameters
from apcc_torch.identification.split import thinned
from apcc_torch.lie import so3
from apcc_torch.lie.rotations import chordal_mean
from apcc_torch.model.arm import Arm

PHYSICS, LEARNING, BOTH = "physics", "learning", "physics and learning"
"""Families of methods."""


@dataclass(frozen=True)
class Known:
    """What a method may know before it learns.

    arm: As it is believed to be built. parameters: Of it, with how far they may be off.
    geometric: The same, of which those are free that say where an arm is whose bends its tendons' lengths tell.
    rest: Moments at which the arm hung straight; None: it is straight as the arm's file says.
    fit: How parameters are fitted. samples: So many moments, evenly spread, a fit of the arm sees.
    seed: Of random numbers. say: Takes a line a step of what takes long. fits: What methods share.
    """

    arm: Arm
    parameters: Parameters
    geometric: Parameters
    rest: Frames | None
    fit: FitSettings
    samples: int
    seed: int
    say: Callable[[str], None]
    fits: dict[tuple[object, ...], Fit] = field(default_factory=dict)

    @cached_property
    def calibration(self) -> RestCalibration:
        """Where the base is, as the arm's file says, and how each body sits beside the straight arm's axis."""
        told = self.parameters.values(self.parameters.nominal())
        turn, base, places = so3.exp(told["base_rotation"]), told["base_position"], self.arm.sensor_places()
        names = tuple(f"body {b + 1}" for b in range(len(places)))
        axes = turn.expand(len(names), 3, 3)
        if self.rest is None:
            straight = torch.nn.functional.pad(places.unsqueeze(-1), (2, 0)) + told["mount"].view(-1, 3)
            return RestCalibration.at_rest(names, base, turn, base + straight @ turn.mT, axes)
        seen = self.rest.rotations.isfinite().flatten(1).all(-1)
        if bool(seen.any()):
            axes = torch.stack([chordal_mean(self.rest.rotations[seen, b]) for b in range(len(names))])
        return RestCalibration.at_rest(names, base, turn, self.rest.positions.quantile(0.5, dim=0), axes)

    def shared(self, name: str, frames: Frames, made: Callable[[], Fit]) -> Fit:
        """The fit of that name to those moments, made once."""
        key = (name, len(frames), float(frames.times[0]), float(frames.times[-1]), float(frames.positions.sum()))
        if key not in self.fits:
            self.fits[key] = made()
        return self.fits[key]

    def values(self, found: Fit) -> dict[str, Tensor]:
        """What a fit of the arm found, without gradient."""
        return {name: value.detach() for name, value in self.parameters.values(found.z).items()}

    def some(self, frames: Frames) -> Frames:
        """Those of the moments that a fit of the arm sees."""
        return frames.at(thinned(torch.arange(len(frames)), self.samples))


class Method(ABC):
    """A row of the leaderboard.

    Attributes:
        family: Physics, learning, or both.
        hindsight: Whether it looks at the answers, as a bound that no method can reach does.

    Args:
        known: What it may know before it learns.
    """

    family: ClassVar[str] = PHYSICS
    hindsight: ClassVar[bool] = False

    def __init__(self, known: Known) -> None:
        self.known = known

    @abstractmethod
    def answers(self, task: Task) -> bool:
        """Whether it takes part in a task."""

    @abstractmethod
    def fit(self, train: Frames) -> None:
        """Learns from moments at which all is shown."""

    @abstractmethod
    def predict(self, test: Frames, task: Task, seen: Frames | None = None) -> Tensor:
        """Where all bodies are (N, k, 3), m, recording frame; of those that are shown anything will do.

        Args:
            test: Moments at which the task's bodies are shown, NaN elsewhere.
            task: What is asked.
            seen: Where the task lets a method follow the load, moments of the same session before `test`, all shown.
                Of a method with hindsight, `test` with all bodies shown.
        """
