"""Rest lengths of the arcs that follow the arm's shape: the law that ships."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, cast

import torch
from torch import Tensor

from apcc_torch.control.length_law import LawStep, LengthLaw, Memory
from apcc_torch.estimation.feedback import FeedbackStatus
from apcc_torch.estimation.shape_feedback import ShapeFeedback, ShapeFeedbackSettings
from apcc_torch.estimation.state_feedback import StateFeedback
from apcc_torch.model.arm import Arm
from apcc_torch.model.kinematic_model import KinematicModel
from apcc_torch.settings import OURS, Setting, aligned, resolved, setting


@dataclass(frozen=True, kw_only=True)
class ShapeLawSettings(ShapeFeedbackSettings):
    """Settings of `ShapeLaw`, and of the `ShapeFeedback` that it works beside."""

    time_constant: Setting | None = setting(
        0.05, "s", OURS, "in which the rest lengths take the elongations over; null: never", rows="number", above=0
    )


class ShapeLaw(LengthLaw):
    """pi_hat_dot = dL / tau, beside a `ShapeFeedback`: where the shape asks a section to be longer, it becomes so.

    There the lengths l = pi + dL of the model's sections are those with which arcs follow the arm's shape best, drawn
    to the nominal ones as far as shape does not tell them. The law leaves l and the shape as they are. It moves what is
    elongation into the rest length, so Psi falls to nothing. Without a time constant the estimator works alone, and
    pi_hat stays what it is. It rests too where the estimate has no ground to move it, and the status says why:
    INVALID, nothing is measured; MISFIT, the arm rests in a shape that its mechanics does not explain, as in contact;
    UNTOLD, what is measured leaves a section to what was believed before.

    Args:
        nominal: (..., n_b) first estimates, m; not used.
        feedback: Algorithm 2; not used.
        *settings, **changes: See `ShapeLawSettings`.

    Raises:
        ValueRangeError: A setting is out of range.

    Example:
        >>> controller = APCCController.for_arm(Arm(lengths=[0.2, 0.25], mass=0.4))
        >>> controller.laws[0].time_constant, controller.shape.shape.refine
        (0.05, 2)
    """

    settings_type = ShapeLawSettings
    time_constant: Setting | None
    needs_velocity = False

    def __init__(self, nominal: Tensor, feedback: StateFeedback, *settings: Any, **changes: Any) -> None:
        super().__init__()
        self.hold(resolved(ShapeLawSettings, settings, changes))

    def shape_feedback(self, arm: Arm, backbone: KinematicModel) -> ShapeFeedback:
        """See `LengthLaw.shape_feedback`."""
        return ShapeFeedback.on(arm, backbone, cast(ShapeLawSettings, self.settings))

    def speed(self, step: LawStep, memory: Memory) -> tuple[Tensor, Memory]:
        """See `LengthLaw.speed`."""
        if self.time_constant is None:
            return torch.zeros_like(step.pi_hat), memory
        status = step.inference.feedback.status
        grounded = (status != int(FeedbackStatus.MISFIT)) & (status != int(FeedbackStatus.UNTOLD))
        dL, dt = step.q_bar[..., step.backbone.coordinates.elongations], step.dt.unsqueeze(-1)
        # In a period longer than tau no more than all of it.
        tau = aligned(self.time_constant, 1)
        speed = dL / (torch.maximum(tau, dt) if isinstance(tau, Tensor) else dt.clamp(min=tau))
        return torch.where(grounded.unsqueeze(-1), speed, 0.0), memory
