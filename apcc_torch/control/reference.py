"""The desired configuration after a control step: the integral of a velocity, within its bounds."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from apcc_torch.control.bounds import RateBounds, ReferenceBounds
from apcc_torch.control.tendon_limits import SolverStatus


class Reference(NamedTuple):
    """qdot (..., n) as it is taken, q_d (..., n) after it, and `SolverStatus` (...) int64."""

    qdot: Tensor
    q_d: Tensor
    limits: Tensor


def moved(
    q_d: Tensor,
    qdot: Tensor,
    dt: Tensor,
    e: Tensor,
    valid: Tensor,
    reference: ReferenceBounds | None,
    bounds: RateBounds | None,
    limits: Tensor | None,
) -> Reference:
    """The reference after dt.

    Args:
        q_d: (..., n) before.
        qdot: (..., n) velocity.
        dt: (...) s.
        e: (..., 3) position error, m, not finite without a target.
        valid: (...) bool, whether something is known of the arm.
        reference: Bounds of q_d; None for none.
        bounds: Of qdot that follow from them; None for none.
        limits: (...) what the solver says of qdot; None for nothing.
    """
    # Where nothing is known of the arm, or of the target, it is told to stay.
    aimed = torch.isfinite(qdot).all(-1) & torch.isfinite(e).all(-1)
    qdot = torch.where((aimed & valid).unsqueeze(-1), qdot, 0.0)
    wished = q_d + dt.unsqueeze(-1) * qdot
    later = wished if reference is None else reference.held(wished)
    limits = torch.where(aimed, SolverStatus.FREE if limits is None else limits, SolverStatus.NOT_FINITE)
    if bounds is not None:
        held = ((qdot == bounds.lower) | (qdot == bounds.upper) | (later != wished)).any(-1)
        limits = torch.where(held & (limits == SolverStatus.FREE), int(SolverStatus.LIMITED), limits)
    # A step that is not finite is not taken: one bad measurement or target must not stay in the integral.
    return Reference(qdot, torch.where(torch.isfinite(later) & valid.unsqueeze(-1), later, q_d), limits)
