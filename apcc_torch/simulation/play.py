"""Play between a motor and its tendon: the play operator [Krasnosel'skii and Pokrovskii, 1989]."""

from __future__ import annotations

import torch
from torch import Tensor

from apcc_torch.control.pid import TendonReference
from apcc_torch.settings import Setting, aligned, is_on


def played(held: Tensor, reference: TendonReference, backlash: Setting) -> TendonReference:
    """What the tendons get of the motors' reference.

    A tendon stays where it was drawn until its motor has crossed the play, and is taken along from then on.

    Args:
        held: (..., n_a) to where the tendons are drawn, m.
        reference: Of the motors.
        backlash: The play, m.
    """
    if not is_on(backlash):
        return reference
    half = 0.5 * aligned(backlash, 1)
    low, high = reference.y_d - half, reference.y_d + half
    held = torch.maximum(torch.minimum(held, high), low)
    rate = torch.where((held == low) | (held == high), reference.ydot_d, 0.0)
    return reference._replace(y_d=held, ydot_d=rate)
