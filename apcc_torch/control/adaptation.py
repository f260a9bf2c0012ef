"""The parameter update law: rest lengths follow the part of the task error that they can explain."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, ClassVar, Self

import torch
from torch import Tensor

from apcc_torch.control.gain import check_gain, gain_matrix
from apcc_torch.control.length_law import LawStep, LengthLaw, Memory
from apcc_torch.estimation.state_feedback import StateFeedback
from apcc_torch.linalg import scaled_within
from apcc_torch.model.coordinates import Coordinates
from apcc_torch.part import hold_rows
from apcc_torch.settings import OURS, PAPER, Setting, Settings, aligned, is_on, resolved, setting
from apcc_torch.shapes import check_same, check_tensor
from apcc_torch.spread import Numbers


@dataclass(frozen=True, kw_only=True)
class AdaptiveLawSettings(Settings):
    """Settings of `AdaptiveLaw`."""

    gamma: Numbers = setting(1.0, "", PAPER, "Gamma of Eq. (15): a number, one a section, or a matrix", rows="gain")
    regressor: str = setting(
        "estimator_aware",
        "",
        OURS,
        "estimator_aware, the total derivative, stable with algorithm 2 in the loop; partial, theorem 1 as printed",
        choices=("partial", "estimator_aware"),
    )
    rate: Setting | None = setting(
        None, "m/s", OURS, "largest speed of a parameter; null: no bound", rows="number", above=0
    )
    normalisation: Setting = setting(0.0, "s^2", OURS, "nu in 1 / (1 + nu |Y|^2)", rows="number", least=0)
    dead_zone: Setting = setting(0.0, "m", OURS, "position error below which nothing adapts", rows="number", least=0)
    gain_scale: Setting = setting(1.0, "", OURS, "factor on gamma", rows="number", above=0)

    def check(self) -> None:
        """Raises where gamma is no positive gain."""
        check_gain("gamma", self.gamma)


class AdaptiveLaw(LengthLaw):
    """pi_hat_dot = -Gamma Y^T e. Eq. (15) [Dalenberg].

    Which Y: the law descends V of Eq. (18) only along d(xdot_hat)/d(pi_hat). Theorem 1's Y is that derivative with q
    held fixed ("partial"), right where q is measured without the model. Where q_bar comes from algorithm 2, q_bar
    itself moves with pi_hat and the derivative is the total one ("estimator_aware"):

        Y_total = Y(q, qdot) + d(J qdot)/dq  dq_bar/dpi,

    with dq_bar/dpi from `StateFeedback.sensitivity`.

    Normalisation, dead zone and rate are off by default: the law is then Eq. (15) and nothing else. Each number may
    also be a tensor (...), one a row.

    Args:
        n_sections: Number of parameters n_b.
        *settings, **changes: See `AdaptiveLawSettings`.

    Raises:
        ValueRangeError: Gamma is not positive definite.

    Example:
        >>> law = AdaptiveLaw(2, gamma=2.0)
        >>> law.velocity(torch.ones(3, 2).double(), torch.tensor([0.01, 0.0, 0.0]).double())
        tensor([-0.0200, -0.0200], dtype=torch.float64)
    """

    settings_type: ClassVar[type[AdaptiveLawSettings]] = AdaptiveLawSettings
    gamma: Tensor
    regressor: str
    rate: Setting | None
    normalisation: Setting
    dead_zone: Setting
    gain_scale: Setting

    def __init__(self, n_sections: int, *settings: Any, **changes: Any) -> None:
        super().__init__()
        s = resolved(type(self).settings_type, settings, changes)
        self.n_sections = n_sections
        self.hold(s)
        hold_rows(self, gamma=(gain_matrix("gamma", s.gamma, n_sections), 2))

    @classmethod
    def on(cls, nominal: Tensor, feedback: StateFeedback, settings: Settings) -> Self:
        """See `LengthLaw.on`."""
        return cls(nominal.shape[-1], settings)

    @property
    def needs_sensitivity(self) -> bool:  # type: ignore[override]
        """Whether dq_bar/dpi is needed: for the total derivative."""
        return self.regressor == "estimator_aware"

    @property
    def metric(self) -> Tensor:
        """(..., n_b, n_b) Gamma, scaled."""
        scale = self.gain_scale
        return self.gamma if isinstance(scale, float) and scale == 1.0 else self.gamma * aligned(scale, 2)

    def velocity(self, Y: Tensor, e: Tensor) -> Tensor:
        """pi_hat_dot (..., n_b), m/s. Eq. (15) [Dalenberg].

        Args:
            Y: (..., 3, n_b) regressor, 1/s.
            e: (..., 3) position error x_d - x, m.
        """
        check_tensor("Y", Y, (3, self.n_sections))
        check_tensor("e", e, (3,))
        check_same(Y=Y, e=e)
        gamma = self.metric.to(dtype=Y.dtype, device=Y.device)
        velocity = -(gamma @ (Y.mT @ e.unsqueeze(-1))).squeeze(-1)  # Eq. (15)
        if is_on(self.normalisation):
            velocity = velocity / (1.0 + aligned(self.normalisation, 1) * Y.square().sum((-1, -2)).unsqueeze(-1))
        if is_on(self.dead_zone):
            velocity = torch.where(e.norm(dim=-1, keepdim=True) > aligned(self.dead_zone, 1), velocity, 0.0)
        return scaled_within(velocity, self.rate)

    def forward(self, pi_hat: Tensor, Y: Tensor, e: Tensor, dt: Tensor) -> Tensor:
        """pi_hat (..., n_b) m after one step of this law alone, without bounds; a step that is not finite is not taken.

        Args:
            pi_hat: (..., n_b) present estimate, m.
            Y: (..., 3, n_b) regressor.
            e: (..., 3) position error, m.
            dt: (...) step, s.
        """
        check_tensor("pi_hat", pi_hat, (self.n_sections,))
        check_tensor("dt", dt, ())
        step = pi_hat + dt.unsqueeze(-1) * self.velocity(Y, e)
        return torch.where(torch.isfinite(step), step, pi_hat)

    def speed(self, step: LawStep, memory: Memory) -> tuple[Tensor, Memory]:
        """See `LengthLaw.speed`."""
        if self.regressor == "partial":
            Y = step.backbone.regressor(step.q_bar, step.qdot)[0]
        else:
            assert step.dq_dpi is not None  # asked for by `needs_sensitivity`
            Y = total_regressor(step.backbone.coordinates, step.chain.jacobian_rate(step.qdot), step.dq_dpi)
        return self.velocity(Y, step.e), memory


@dataclass(frozen=True, kw_only=True)
class NormalisedLawSettings(AdaptiveLawSettings):
    """Settings of `NormalisedLaw`."""

    gamma: Numbers = setting(50.0, "", OURS, "Gamma of Eq. (15): a number, one a section, or a matrix", rows="gain")
    normalisation: Setting = setting(
        10.0, "s^2", OURS, "nu in 1 / (1 + nu |Y|^2): without it the paper's Gamma overshoots", rows="number", least=0
    )
    dead_zone: Setting = setting(
        6e-4,
        "m",
        OURS,
        "position error below which nothing adapts: what holding qdot for a period leaves",
        rows="number",
        least=0,
    )


class NormalisedLaw(AdaptiveLaw):
    """Eq. (15) as it ships: along the total derivative, normalised, with a dead zone.

    Example:
        >>> NormalisedLaw(2).normalisation
        10.0
    """

    settings_type = NormalisedLawSettings


def total_regressor(coordinates: Coordinates, rate: Tensor, dq_dpi: Tensor) -> Tensor:
    """Y + d(J qdot)/dq dq_bar/dpi (..., 3, n_b) from Jdot (..., 3, n), whose columns of delta L are Y, Eq. (8)."""
    return rate[..., coordinates.elongations] + rate @ dq_dpi
