"""What a control step asks its velocity from."""

from __future__ import annotations

from typing import NamedTuple

from torch import Tensor

from apcc_torch.control.bounds import RateBounds
from apcc_torch.control.step_io import ControllerState, Measurement, Target
from apcc_torch.model.kinematic_model import Placed


class Asked(NamedTuple):
    """What `APCCController._solve` is given in a step.

    state, measurement, target: Of the step.
    q, pi_hat, chain: Configuration (..., n), rest lengths (..., n_b), m, and chain that the tendons drive.
    e: (..., 3) position error that is acted on, m.
    dt: (...) s since the last step.
    bounds: Of qdot; None without any.
    """

    state: ControllerState
    measurement: Measurement
    target: Target
    q: Tensor
    pi_hat: Tensor
    chain: Placed
    e: Tensor
    dt: Tensor
    bounds: RateBounds | None
