"""How well the lengths that become rest lengths are known, as the shape that they follow is."""

from __future__ import annotations

import torch
from torch import Tensor

from apcc_torch.estimation.shape_feedback import FollowedShape, ShapeFeedback
from apcc_torch.shapes import check_tensor

STEPS = 20
"""Of the fit, in which it comes to rest on a shape near by."""
RENEWALS = 15
"""Times that the sag is renewed, by a share each, until it is that of the shape."""
REACH = 3.0**0.5
"""How many deviations away shapes are tried: the root of a normal number's kurtosis gives squares their weight."""


def length_covariance(
    feedback: ShapeFeedback, state: FollowedShape, q_bar: Tensor, pi_hat: Tensor, covariance: Tensor
) -> Tensor:
    """Mean square (..., n_b, n_b), m^2, of what the lengths l = pi + dL of the model's sections are off by.

    They are what the fit makes of the shape's strains and load s. What is estimated is l(s) of the true s: the lengths
    that the same fit, drawn to the same nominal ones, finds for the true shape. The law's rest lengths follow l with a
    time constant, pi_hat_dot = dL / tau, which averages what comes and goes: of an arm at rest they are off by less.

    Arcs that run along a shape change their lengths much for a little of it, and not in proportion. Where the fit has
    several valleys, this is of the one that q_bar lies in, and says too little. l is taken at
    s +- sqrt(3) S_i, with S S^T the covariance of s, and its slopes and curvatures are those of divided differences:
    with d_i = (l+ - l-) / (2 sqrt 3), c_i = (l+ + l- - 2 l) / 6 and b the sum of the c_i,

        sum d_i d_i^T + 2 sum c_i c_i^T + b b^T

    (Noergaard, Poulsen and Ravn 2000, with the mean's own shift).

    Args:
        feedback: The estimator.
        state: Of a step.
        q_bar: (..., n) that the step found.
        pi_hat: (..., n_b) its rest lengths, m.
        covariance: (..., n_s, n_s) of the strains and the load, such as of `ShapeFeedback.covariance`. What is none
            makes its row NaN.

    Raises:
        ShapeError: An argument has the wrong last dimensions.

    Example:
        >>> from apcc_torch import Arm
        >>> from apcc_torch.estimation.shape_feedback import ShapeFeedbackSettings
        >>> arm = Arm(lengths=[0.2, 0.25], mass=0.4)
        >>> feedback = ShapeFeedback.on(arm, arm.backbone(), ShapeFeedbackSettings())
        >>> q, L0 = torch.tensor([0.5, 0.0, 0.0, 0.3, 0.2, 0.0]).double(), arm.rest_lengths()
        >>> length_covariance(feedback, feedback.initial_state(q, L0), q, L0, 1e-6 * torch.eye(7).double()).shape
        torch.Size([2, 2])
    """
    shape, places = state.shape, feedback.fit.backbone.coordinates.elongations
    n_s = shape.sections.shape[-1] + 1
    check_tensor("q_bar", q_bar, (feedback.fit.backbone.n,))
    check_tensor("pi_hat", pi_hat, (feedback.fit.nominal.shape[-1],))
    check_tensor("covariance", covariance, (n_s, n_s))
    root, failed = torch.linalg.cholesky_ex(covariance)
    away = REACH * root.movedim(-1, 0)  # (n_s, ..., n_s): a column each
    away = torch.cat((torch.zeros_like(away[:1]), away, -away))
    every = away.shape[:-1]
    sag = shape.sag.expand(*every, *shape.sag.shape[-2:])
    tried = shape._replace(sections=shape.sections + away[..., :-1], load=shape.load + away[..., -1], sag=sag)
    # An arm at rest sags as its shape has it, where the estimate's own sag is late.
    for _ in range(RENEWALS):
        tried = tried._replace(sag=feedback.shape.renewed(tried, torch.full_like(tried.load, torch.inf)))
    tried = tried._replace(sag=torch.cat((sag[:1], tried.sag[1:])))
    points, share = feedback.curve(tried)
    q, pi_hat = q_bar.expand(*every, q_bar.shape[-1]), pi_hat.expand(*every, pi_hat.shape[-1])
    for _ in range(STEPS):
        q = feedback.fit(q, pi_hat, points, share)
    at, ahead, behind = q[..., places].split((1, n_s, n_s))
    slopes, curved = (ahead - behind) / (2.0 * REACH), (ahead + behind - 2.0 * at) / (2.0 * REACH**2)
    shift = curved.sum(0, keepdim=True)
    parts = torch.cat((slopes, (REACH**2 - 1.0) ** 0.5 * curved, shift))
    known = (failed == 0) & torch.isfinite(root).flatten(-2).all(-1)
    return torch.where(known[..., None, None], (parts.unsqueeze(-1) * parts.unsqueeze(-2)).sum(0), torch.nan)
