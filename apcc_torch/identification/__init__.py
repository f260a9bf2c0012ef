"""An arm's parameters from its recorded motion, with how well each of them is known."""

from __future__ import annotations

from apcc_torch.identification.fit import fit
from apcc_torch.identification.intervals import intervals, unknown_directions
from apcc_torch.identification.parameters import Block, Parameters
from apcc_torch.identification.series import Series, read_series, series_of
from apcc_torch.identification.split import split
from apcc_torch.identification.tendon_arm import TendonArm

__all__ = [
    "Block",
    "Parameters",
    "Series",
    "TendonArm",
    "fit",
    "intervals",
    "read_series",
    "series_of",
    "split",
    "unknown_directions",
]
