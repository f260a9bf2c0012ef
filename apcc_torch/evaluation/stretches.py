"""Stretches of what is learned from, each held back once: what an arm that was identified without it says of it."""

from __future__ import annotations

import torch
from torch import Tensor

from apcc_torch.evaluation.frames import Frames
from apcc_torch.evaluation.method import Known
from apcc_torch.identification.fit import Fit, fit
from apcc_torch.identification.parameters import Values
from apcc_torch.identification.tendon_arm import TendonArm

FOLDS = 3
"""Stretches."""


def stretches(count: int) -> Tensor:
    """(count,) the stretch of each moment, in the order of time."""
    return torch.arange(count) * FOLDS // count


def outside(folds: Tensor, fold: int) -> Tensor:
    """Indices of the moments that are not of a stretch."""
    return (folds != fold).nonzero().squeeze(-1)


def identified_by(known: Known, others: Frames, found: Fit) -> Values:
    """The arm's values by these moments alone, one round of identification from those of all."""
    some, settings = known.some(others), known.fit.changed(rounds=1)
    again = known.shared("identified without a stretch", some, lambda: fit(
        TendonArm(known.arm), known.parameters, some.drive, some.positions, settings, found.z
    ))  # fmt: skip
    return known.values(again)
