"""Which samples a fit may see, and which judge it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, NamedTuple

import torch
from torch import Tensor

from apcc_torch.errors import ConfigError, DataError
from apcc_torch.settings import OURS, Settings, resolved, setting


@dataclass(frozen=True, kw_only=True)
class SplitSettings(Settings):
    """Which part of a recording is held back for validation."""

    by: str = setting(
        "blocks",
        "",
        OURS,
        "groups: whole movements; blocks: stretches of equal length, the last for a prediction of what comes later",
        choices=("groups", "blocks"),
    )
    folds: int = setting(5, "", OURS, "parts that the recording is cut into", least=2)
    fold: int = setting(4, "", OURS, "the part that is held back, from 0", least=0)

    def check(self) -> None:
        """Raises ConfigError where there is no such part."""
        if self.fold >= self.folds:
            raise ConfigError(f"fold must be from 0 to folds - 1, got {self.fold} of {self.folds}")


class Split(NamedTuple):
    """Indices of samples, each in the order of time; no sample is in both."""

    training: Tensor
    validation: Tensor

    def within(self, seen: Tensor) -> Split:
        """Those samples alone that are `seen` (N,).

        Raises:
            DataError: None is left of a part that had some.
        """
        parts = [index[seen[index]] for index in self]
        for name, before, after in zip(self._fields, self, parts, strict=True):
            if len(before) and not len(after):
                raise DataError(f"no sample for {name} has every body tracked")
        return Split(*parts)


def split(groups: Tensor, *given: Any, **changes: Any) -> Split:
    """Holds one part back for validation.

    Args:
        groups: (N,) int64 number of each sample's movement.
        *given, **changes: See `SplitSettings`. With groups every folds-th movement is held back.

    Raises:
        DataError: The recording has too few movements or samples.
    """
    settings = resolved(SplitSettings, given, changes)
    by, folds, fold = settings.by, settings.folds, settings.fold
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
