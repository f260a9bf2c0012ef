"""Material points of an arm by section and share of it, so that they stay where they are on longer arms."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from apcc_torch.model.abscissae import decouple
from apcc_torch.model.arm import Arm


class Places(NamedTuple):
    """P material points.

    section: (P,) int64, zero-based.
    share: (P,) of the section, from 0 at its base to 1 at its end.
    """

    section: Tensor
    share: Tensor

    def to(self, like: Tensor) -> Places:
        """Of the dtype and device of `like`."""
        return Places(self.section.to(like.device), self.share.to(like))

    def on(self, lengths: Tensor) -> Tensor:
        """Their abscissae (..., P), m, on arms whose sections have rest lengths (..., n_b), m."""
        ends = torch.nn.functional.pad(lengths.cumsum(-1), (1, 0))
        return torch.lerp(ends[..., self.section], ends[..., self.section + 1], self.share)


def middles_and_ends(n_sections: int) -> Places:
    """The middle and the end of every section, from base to tip."""
    shares = torch.tensor([0.5, 1.0], dtype=torch.float64).repeat(n_sections)
    return Places(torch.arange(n_sections).repeat_interleave(2), shares)


def places(X: Tensor, lengths: Tensor) -> Places:
    """The points at abscissae X (P,), m, of an arm with rest lengths (n_b,), m; one on a boundary ends a section."""
    share, section = decouple(X, lengths)
    # An end that a file tells and the sum of the lengths differ by rounding.
    share = share.round(decimals=12)
    begins = (share == 0.0) & (section > 0)
    return Places(torch.where(begins, section - 1, section), share.masked_fill(begins, 1.0))


def sensors_of(arm: Arm, true: bool = False) -> Places:
    """The arm's sensors, as believed or as they truly are; at its tip there is always one.

    An episode is about the tip, so an arm whose last sensor is believed elsewhere has one more, there.
    """
    lengths, believed = arm.rest_lengths(), arm.sensor_places()
    X, end = arm.true_sensor_places() if true else believed, lengths.sum(-1, keepdim=True)
    if bool(believed[-1] < (1.0 - 1e-6) * end):
        X = torch.cat((X, end))
    return places(X, lengths)
