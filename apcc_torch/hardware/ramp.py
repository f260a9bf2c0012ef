"""Tendons on a given way instead of a controller's: experiment I of the paper."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor

from apcc_torch.control.controller import APCCController
from apcc_torch.control.step_io import Target
from apcc_torch.control.trajectory import SetPoint
from apcc_torch.errors import ValueRangeError
from apcc_torch.hardware.control import Control, Decision, Step
from apcc_torch.hardware.interfaces import Array
from apcc_torch.hardware.sensing import Seen
from apcc_torch.settings import check_setting


@dataclass(frozen=True)
class Ramp:
    """Length changes that go from zero to `goal` (n_a,), m, in `duration`, s, and stay there.

    Raises:
        ValueRangeError: A number is out of range.
    """

    goal: Array
    duration: float

    def __post_init__(self) -> None:
        """Checks the numbers."""
        if not np.isfinite(self.goal).all():
            raise ValueRangeError(f"ramp.goal must be finite, got {self.goal.tolist()}")
        check_setting("ramp.duration", self.duration)

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

    def decide(self, seen: Seen, time: float, target: Target | None = None) -> Decision:
        """One step: the ramp's lengths, and what the controller infers."""
        if target is None:
            tip = torch.tensor(seen.T[-1, :3, 3], dtype=self.pi_hat.dtype)
            target = Target(tip, torch.zeros_like(tip))
        return replace(super().decide(seen, time, target), y=self.ramp.at(time))
