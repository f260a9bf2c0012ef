"""Bounds of the rest lengths, relative to the arm: whatever laws run, pi_hat stays within them."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from apcc_torch.errors import ConfigError, ValueRangeError
from apcc_torch.modes import holds, none_left
from apcc_torch.part import Part, hold_rows, refuse_parameter
from apcc_torch.settings import OURS, Settings, resolved, setting
from apcc_torch.shapes import check_finite, check_positive, check_tensor
from apcc_torch.spread import Numbers, spread


@dataclass(frozen=True, kw_only=True)
class LengthBoundsSettings(Settings):
    """Settings of `LengthBounds`."""

    lower: Numbers | None = setting(
        0.2, "", OURS, "smallest rest lengths over the nominal ones; null: no bound", rows="sections", above=0
    )
    upper: Numbers | None = setting(
        5.0, "", OURS, "largest rest lengths over the nominal ones; null: no bound", rows="sections", above=0
    )
    reach: str = setting(
        "free",
        "",
        OURS,
        "free; last, all sections together reach the last sensor; each, the first i reach sensor i",
        choices=("free", "last", "each"),
    )


class LengthBounds(Part):
    """Projects pi_hat onto bounds of every section, then onto a least reach of the sections together.

    A reach says that the sensors are on the arm. Where sum(pi_hat) is less than the farthest sensor's abscissa, remark
    3 attaches it to the model's tip, a longer delta L explains it as well as a longer rest length, and no measurement
    tells the two apart. A sensor in every section is what positions alone need to determine q_bar.

    Args:
        nominal: (..., n_b) m, what the bounds are relative to.
        abscissae: (..., k) of the sensors, m, for a reach.
        *settings, **changes: See `LengthBoundsSettings`.

    Raises:
        ConfigError: "each" has other than one sensor a section.
        ValueRangeError: Bounds cross, or the abscissae do not increase.

    Example:
        >>> bounds = LengthBounds(torch.tensor([0.2, 0.25]), torch.tensor([0.2, 0.45]), lower=0.75, reach="last")
        >>> bounds(torch.tensor([0.1, 0.25]))
        tensor([0.1750, 0.2750])
    """

    settings_type = LengthBoundsSettings
    least: Tensor | None
    largest: Tensor | None
    ends: Tensor | None

    def __init__(self, nominal: Tensor, abscissae: Tensor | None = None, *settings: Any, **changes: Any) -> None:
        super().__init__()
        s = resolved(LengthBoundsSettings, settings, changes)
        for name, value in {"nominal": nominal, "abscissae": abscissae, "lower": s.lower, "upper": s.upper}.items():
            refuse_parameter(name, value, "bounds in metres are made of it once; hand in a plain tensor")
        check_finite("nominal", check_tensor("nominal", nominal, (None,)))
        n_b = nominal.shape[-1]
        with nominal.device:  # where numbers become tensors
            least, largest = (
                None if share is None else spread(name, share, n_b).to(nominal) * nominal
                for name, share in {"lower": s.lower, "upper": s.upper}.items()
            )
        if least is not None and largest is not None and not holds(least < largest):
            raise ValueRangeError(f"lower must be below upper for every section, got {s.lower} and {s.upper}")
        hold_rows(self, least=(least, 1), largest=(largest, 1), ends=(_ends(s.reach, abscissae, n_b), 1))
        # How many sections each wanted end lies behind; one that is zero asks for nothing.
        self._reaching = (
            [] if self.ends is None else [i + 1 for i in range(n_b) if not none_left(self.ends[..., i] > 0)]
        )
        self.hold(s)

    def forward(self, pi_hat: Tensor, metric: Tensor | None = None) -> Tensor:
        """The nearest allowed parameters (..., n_b), m.

        Args:
            pi_hat: (..., n_b) m.
            metric: (..., n_b, n_b) Gamma. Half-space by half-space the reach is projected in the norm of Gamma^-1, in
                which V of Eq. (18) measures: it brings pi_hat nearer to every pi that reaches as far, so the proof's V
                still falls. None for the identity.
        """
        check_tensor("pi_hat", pi_hat, (None,))
        if self.least is not None:
            pi_hat = torch.maximum(pi_hat, self.least.to(pi_hat))
        if self.largest is not None:
            pi_hat = torch.minimum(pi_hat, self.largest.to(pi_hat))
        if self.ends is not None:
            ends, n_b = self.ends.to(pi_hat), pi_hat.shape[-1]
            identity = torch.eye(n_b, dtype=pi_hat.dtype, device=pi_hat.device)
            gamma = identity if metric is None else metric.to(pi_hat)
            for i in self._reaching:
                toward = gamma[..., :i].sum(-1)
                short = (ends[..., i - 1 : i] - pi_hat[..., :i].sum(-1, keepdim=True)).clamp(min=0.0)
                pi_hat = pi_hat + short * toward / toward[..., :i].sum(-1, keepdim=True)
        return pi_hat


def _ends(reach: str, abscissae: Tensor | None, n_b: int) -> Tensor | None:
    """(..., n_b) least ends of the sections, m; zero for none."""
    if reach == "free":
        return None
    if abscissae is None:
        raise ConfigError(f"reach={reach} needs the sensors' abscissae")
    check_positive("the last of the abscissae", check_tensor("abscissae", abscissae, (None,))[..., -1])
    check_positive("each step of the abscissae", abscissae.diff(dim=-1))
    if reach == "each":
        if abscissae.shape[-1] != n_b:
            raise ConfigError(f"reach=each needs one sensor a section, got {abscissae.shape[-1]} for {n_b}")
        return abscissae
    return torch.nn.functional.pad(abscissae[..., -1:], (n_b - 1, 0))
