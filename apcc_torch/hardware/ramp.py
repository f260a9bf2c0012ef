"""Tendons on a given way instead of a controller's: experiment I of the paper."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
from torch import Tensor

from apcc_torch.control.controller import APCCController
from apcc_torch.control.trajectory import SetPoint
from apcc_torch.errors import ConfigError, ValueRangeError
from apcc_torch.hardware.control import Control, Decision, Goal, Step
from apcc_torch.hardware.interfaces import Array
from apcc_torch.hardware.sensing import GatedFrame
from apcc_torch.settings import OURS, PAPER, Settings, resolved, setting
from apcc_torch.spread import spread


@dataclass(frozen=True, kw_only=True)
class RampSettings(Settings):
    """Where the tendons go in an experiment of kind tendons: from zero to the goal, and on there."""

    goal: tuple[float, ...] | None = setting(
        None, "m", PAPER, "one length change a tendon; of chambers one pressure each, Pa"
    )
    duration: float = setting(10.0, "s", OURS, "from zero to the goal", above=0)
    estimate: tuple[float, ...] | None = setting(
        None, "m", PAPER, "pi_hat of the decoupled estimators; null: none", above=0
    )


class Ramp:
    """Length changes that go from zero to their goal, and stay there.

    Raises:
        ConfigError: There is no goal, or it has not one entry a tendon.
        ValueRangeError: A number is not finite.
    """

    def __init__(self, n_tendons: int, *given: Any, **changes: Any) -> None:
        settings = resolved(RampSettings, given, changes)
        if settings.goal is None:
            raise ConfigError("goal must be given for an experiment of kind tendons")
        self.goal: Array = spread("goal", settings.goal, n_tendons).numpy()
        self.duration = settings.duration
        if not np.isfinite(self.goal).all():
            raise ValueRangeError(f"goal must be finite, got {self.goal.tolist()}")

    def at(self, time: float) -> Array:
        """(n_a,) m at `time`, s."""
        return self.goal * min(max(time / self.duration, 0.0), 1.0)


class RampControl(Control):
    """Sends a ramp; the controller looks on, with the measured tip as its target, so that it asks for nothing.

    Args:
        controller: With a routing; it infers the model's state.
        pi_hat: (n_b,) m.
        ramp: Where the tendons go.
        step: As of `Control`.
    """

    def __init__(self, controller: APCCController, pi_hat: Tensor, ramp: Ramp, step: Step | None = None) -> None:
        super().__init__(controller, SetPoint(torch.zeros(3, dtype=pi_hat.dtype)), pi_hat, step)
        self.ramp = ramp

    def decide(self, frame: GatedFrame, lengths: Array, time: float, goal: Goal | None = None) -> Decision:
        """One step: the ramp's lengths, and what the controller infers."""
        if goal is None:
            goal = Goal(frame.T[-1, :3, 3], np.zeros(3))
        decision, way = super().decide(frame, lengths, time, goal), self.ramp.at(time)
        return replace(decision, pressure=way) if self.sets_pressure else replace(decision, y=way)
