"""An arm's parameters from its recorded motion, with how well each of them is known."""

from __future__ import annotations

from apcc_torch.identification.arm_blocks import Spreads, arm_parameters, identified_arm
from apcc_torch.identification.fit import FitSettings, fit
from apcc_torch.identification.intervals import intervals, unknown_directions
from apcc_torch.identification.parameters import Block, Parameters
from apcc_torch.identification.series import Series, read_series, series_of
from apcc_torch.identification.split import SplitSettings, split
from apcc_torch.identification.tendon_arm import TendonArm

__all__ = [
    "Block",
    "FitSettings",
    "Parameters",
    "Series",
    "SplitSettings",
    "Spreads",
    "TendonArm",
    "arm_parameters",
    "fit",
    "identified_arm",
    "intervals",
    "read_series",
    "series_of",
    "split",
    "unknown_directions",
]
