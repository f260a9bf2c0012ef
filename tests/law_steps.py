"""What the controller tells a law of the rest lengths, for laws that are tried alone."""

from __future__ import annotations

import torch
from torch import Tensor

from apcc_torch.control.length_law import LawStep
from apcc_torch.estimation.state_feedback import StateFeedback


def law_step(
    feedback: StateFeedback, q: Tensor, pi: Tensor, T: Tensor, dt: Tensor, sensitivity: bool = True
) -> LawStep:
    """A step at q_bar = q (..., n) and pi_hat = pi (..., n_b) with poses T (..., k, 4, 4), dt () s after the last.

    The arm's regressor has no velocity and the task no error: laws of residuals read neither.
    """
    backbone = feedback.backbone
    # Within thresholds as wide as these no iteration moves q.
    wide = {"min_iterations": 0, "linear_threshold": 1e9, "angular_threshold": 1e9}
    still = StateFeedback(backbone, feedback.abscissae, feedback.mode, feedback.angular_weight, **wide)
    return LawStep(
        backbone,
        still.infer(q, pi, T),
        q_bar=q,
        pi_hat=pi,
        qdot=torch.zeros_like(q),
        e=torch.zeros_like(q[..., :3]),
        dt=dt.expand(pi.shape[:-1]),
        T=T,
        abscissae=feedback.abscissae,
        chain=backbone.chain(q, pi),
        dq_dpi=feedback.sensitivity(q, pi, T=T) if sensitivity else None,
    )
