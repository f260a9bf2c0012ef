"""Which samples a fit may see, and which judge it."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from apcc_torch.errors import ConfigError, DataError


class Split(NamedTuple):
    """Indices of samples, each in the order of time; no sample is in both."""

    training: Tensor
    validation: Tensor


def split(groups: Tensor, by: str, folds: int, fold: int) -> Split:
    """Holds one of `folds` parts back for validation.

    Args:
        groups: (N,) int64 number of each sample's movement.
        by: "groups": every folds-th movement, whole, is held back; "blocks": the recording is cut into `folds`
            stretches of equal length and one is held back, the last for a prediction of what comes later.
        folds: Number of parts.
        fold: Which is held back, from 0.

    Raises:
        ConfigError: A setting has no meaning.
        DataError: The recording has too few movements or samples.
    """
    if by not in ("groups", "blocks"):
        raise ConfigError(f"split.by must be groups or blocks, got {by!r}")
    if folds < 2 or not 0 <= fold < folds:
        raise ConfigError(f"split.fold must be from 0 to split.folds - 1, and folds at least 2, got {fold} of {folds}")
    N = len(groups)
    part = groups % folds if by == "groups" else torch.arange(N) * folds // N
    training, validation = ((part != fold).nonzero()[:, 0], (part == fold).nonzero()[:, 0])
    if not len(training) or not len(validation):
        what = "movements" if by == "groups" else "samples"
        raise DataError(f"the recording has too few {what} to hold back part {fold} of {folds}; split.by={by}")
    return Split(training, validation)


def thinned(index: Tensor, count: int) -> Tensor:
    """At most `count` of the indices, evenly spread."""
    if len(index) <= count:
        return index
    return index[torch.arange(count) * len(index) // count]
