"""What every law of the rest lengths is: from what a control step knows to the speed of the parameters."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterable
from typing import Any, NamedTuple, Self

import torch
from torch import Tensor

from apcc_torch.control.length_bounds import LengthBounds
from apcc_torch.estimation.feedback import Inference
from apcc_torch.estimation.shape_feedback import ShapeFeedback
from apcc_torch.estimation.state_feedback import StateFeedback
from apcc_torch.model.arm import Arm
from apcc_torch.model.kinematic_model import KinematicModel, Placed
from apcc_torch.part import Part
from apcc_torch.settings import Settings

Memory = Any
"""What a law remembers between steps: a NamedTuple of tensors, or None."""


class LawStep(NamedTuple):
    """What a control step knows when the laws run. Vectors have the leading shape of the step.

    backbone: The model.
    inference: Algorithm 2's, with the sensors that it used.
    q_bar: (..., n). pi_hat: (..., n_b) m. qdot: (..., n) the velocity of the regressor.
    e: (..., 3) position error, m, zero where the tip was not measured. dt: (...) s since the last sample.
    T: (..., k, 4, 4) sensor poses. abscissae: (..., k) where they are, m.
    chain: The model at (q_bar, pi_hat), up to the tip.
    dq_dpi: (..., n, n_b) the total derivative of q_bar, see `StateFeedback.sensitivity`; None if no law needs it.
    """

    backbone: KinematicModel
    inference: Inference
    q_bar: Tensor
    pi_hat: Tensor
    qdot: Tensor
    e: Tensor
    dt: Tensor
    T: Tensor
    abscissae: Tensor
    chain: Placed
    dq_dpi: Tensor | None


class LengthLaw(Part, ABC):
    """A law of the rest lengths pi_hat. The controller adds up the speeds of its laws, and bounds the sum.

    A class of one's own derives from this, names its settings, and takes (nominal, feedback, settings):

        class Leak(LengthLaw):
            settings_type = LeakSettings

            def __init__(self, nominal: Tensor, feedback: StateFeedback, *settings: Any, **changes: Any) -> None:
                super().__init__()
                hold_rows(self, nominal=(nominal, 1))
                self.hold(resolved(LeakSettings, settings, changes))

            def speed(self, step: LawStep, memory: Memory) -> tuple[Tensor, Memory]:
                return (self.nominal - step.pi_hat) / self.time, memory

    The command line runs it as `adaptation=custom adaptation.kind=package.module.Leak adaptation.time=2`.
    """

    needs_sensitivity: bool = False
    """Whether `LawStep.dq_dpi` is needed."""
    needs_velocity: bool = True
    """Whether `LawStep.qdot` is needed."""

    @classmethod
    def on(cls, nominal: Tensor, feedback: StateFeedback, settings: Settings) -> Self:
        """The law of a controller.

        Args:
            nominal: (..., n_b) first estimates, m.
            feedback: The controller's algorithm 2.
            settings: Of `settings_type`.
        """
        return cls(nominal, feedback, settings)

    def shape_feedback(self, arm: Arm, backbone: KinematicModel) -> ShapeFeedback | None:
        """What gives q_bar in place of algorithm 2 where this law runs; None for algorithm 2.

        Args:
            arm: As it is believed to be.
            backbone: The controller's model.
        """
        return None

    @property
    def metric(self) -> Tensor | None:
        """(..., n_b, n_b) the gain whose inverse measures distances of pi_hat; None for the identity."""
        return None

    def initial_memory(self, q: Tensor, pi_hat: Tensor) -> Memory:
        """What is known before the first step, of the batch of q (..., n) and pi_hat (..., n_b)."""
        return None

    @abstractmethod
    def speed(self, step: LawStep, memory: Memory) -> tuple[Tensor, Memory]:
        """pi_hat_dot (..., n_b), m/s, and what is remembered after this step; unchecked."""


def adapted(
    laws: Iterable[LengthLaw], bounds: LengthBounds | None, step: LawStep, memories: tuple[Memory, ...], valid: Tensor
) -> tuple[Tensor, tuple[Memory, ...]]:
    """pi_hat (..., n_b) m after a step of all laws within their bounds, and what each remembers.

    Args:
        laws: At least one.
        bounds: Of pi_hat; None for none.
        step: What is known.
        memories: What each law remembered.
        valid: (...) bool, rows that there is an estimate of.
    """
    speed, metric, later = None, None, []
    for law, memory in zip(laws, memories, strict=True):
        own, memory = law.speed(step, memory)
        speed = own if speed is None else speed + own
        metric = law.metric if metric is None else metric
        later.append(memory)
    assert speed is not None  # there is a law
    moved = step.pi_hat + step.dt.unsqueeze(-1) * speed
    # A step that is not finite is not taken: one bad measurement must not lose what was learnt. Nor is one where
    # there is no estimate to learn from.
    moved = torch.where(torch.isfinite(moved) & valid.unsqueeze(-1), moved, step.pi_hat)
    return moved if bounds is None else bounds(moved, metric), tuple(later)
