"""The parameter update law: rest lengths follow the part of the task error that they can explain."""

from __future__ import annotations

import torch
from torch import Tensor

from apcc_torch.control.bounds import scaled_within
from apcc_torch.control.gain import gain_matrix
from apcc_torch.errors import ValueRangeError
from apcc_torch.modes import holds, none_left
from apcc_torch.part import Part, check_settings, check_settings_or_zero, hold, hold_rows
from apcc_torch.settings import Setting, aligned, is_used
from apcc_torch.shapes import check_finite, check_same, check_tensor

REGRESSORS = ("partial", "estimator_aware", "none")


class AdaptiveLaw(Part):
    """pi_hat_dot = -Gamma Y^T e. Eq. (15) [Dalenberg].

    Which Y: the law descends V of Eq. (18) only along d(xdot_hat)/d(pi_hat). Theorem 1's Y is that derivative with q
    held fixed ("partial"), right where q is measured without the model. Where q_bar comes from algorithm 2, q_bar
    itself moves with pi_hat and the derivative is the total one ("estimator_aware"):

        Y_total = Y(q, qdot) + d(J qdot)/dq  dq_bar/dpi,

    with dq_bar/dpi from `StateFeedback.sensitivity`. The controller passes the one this law names.

    Bounds, normalisation and dead zone are off by default: the law is then Eq. (15) and nothing else. Each number may
    also be a tensor (...), one a row.

    Args:
        n_sections: Number of parameters n_b.
        gamma: Adaptation gain Gamma, a number, a (n_b,) diagonal or (..., n_b, n_b).
        regressor: "partial", "estimator_aware", or "none" where another law alone moves the parameters.
        lower: (..., n_b) smallest rest lengths, m; None for no bound.
        upper: (..., n_b) largest rest lengths, m; None for no bound.
        rate: Largest speed of a parameter, m/s; None for no bound. A row over it is scaled whole.
        normalisation: nu in Gamma Y^T e / (1 + nu ||Y||_F^2), s^2; 0 for the plain law.
        dead_zone: Position error below which a row does not adapt, m.
        reach: How far the first i sections together reach at least, m: (..., n_b), not decreasing, zeros for no bound;
            or a number, for all sections together; None for none. The last entry at the farthest sensor's abscissa
            says that the sensor is on the arm: where sum(pi_hat) is less, remark 3 attaches it to the model's tip, a
            longer delta L explains it as well as a longer rest length, and no measurement tells the two apart. Entry i
            at the abscissa of sensor i keeps a sensor in every section, without which positions alone do not determine
            q_bar.

    Raises:
        ValueRangeError: Gamma is not positive definite, or bounds cross or are not positive.
    """

    gamma: Tensor
    lower: Tensor | None
    upper: Tensor | None
    reach: Tensor | None
    rate: Setting | None
    normalisation: Setting
    dead_zone: Setting

    def __init__(
        self,
        n_sections: int,
        gamma: float | Tensor,
        regressor: str = "estimator_aware",
        lower: Tensor | None = None,
        upper: Tensor | None = None,
        rate: Setting | None = None,
        normalisation: Setting = 0.0,
        dead_zone: Setting = 0.0,
        reach: float | Tensor | None = None,
    ) -> None:
        super().__init__()
        if regressor not in REGRESSORS:
            raise ValueRangeError(f"regressor must be one of {', '.join(REGRESSORS)}, got {regressor!r}")
        hold_rows(self, gamma=(gain_matrix("gamma", gamma, n_sections), 2))
        check_settings_or_zero(normalisation=normalisation, dead_zone=dead_zone)
        check_settings(rate=rate)
        for name, bound in {"lower": lower, "upper": upper}.items():
            if bound is not None:
                check_finite(name, check_tensor(name, bound, (n_sections,)))
        if lower is not None and not holds(lower > 0):
            raise ValueRangeError("lower must be positive: a section cannot have no length")
        if lower is not None and upper is not None and not holds(lower < upper):
            raise ValueRangeError("lower must be below upper for every section")
        hold_rows(self, lower=(lower, 1), upper=(upper, 1))
        self.regressor = regressor
        hold(self, rate=rate, normalisation=normalisation, dead_zone=dead_zone)
        self._normalised, self._has_dead_zone = is_used(normalisation), is_used(dead_zone)
        ends = None if reach is None else _cumulative_reach(reach, n_sections)
        hold_rows(self, reach=(ends, 1))
        # How many sections each wanted end lies behind; one that is zero asks for nothing.
        self._reaching = [] if ends is None else [i + 1 for i in range(n_sections) if not none_left(ends[..., i] > 0)]

    def velocity(self, Y: Tensor, e: Tensor) -> Tensor:
        """pi_hat_dot (..., n_b), m/s, before projection. Eq. (15) [Dalenberg].

        Args:
            Y: (..., 3, n_b) regressor, 1/s.
            e: (..., 3) position error x_d - x, m.
        """
        check_tensor("Y", Y, (3, self.gamma.shape[-1]))
        check_tensor("e", e, (3,))
        check_same(Y=Y, e=e)
        if self.regressor == "none":
            return torch.zeros_like(Y[..., 0, :])
        gamma = self.gamma.to(dtype=Y.dtype, device=Y.device)
        velocity = -(gamma @ (Y.mT @ e.unsqueeze(-1))).squeeze(-1)  # Eq. (15)
        if self._normalised:
            velocity = velocity / (1.0 + aligned(self.normalisation, 1) * Y.square().sum((-1, -2)).unsqueeze(-1))
        if self._has_dead_zone:
            velocity = torch.where(e.norm(dim=-1, keepdim=True) > aligned(self.dead_zone, 1), velocity, 0.0)
        return scaled_within(velocity, self.rate)

    def forward(self, pi_hat: Tensor, Y: Tensor, e: Tensor, dt: Tensor, other: Tensor | None = None) -> Tensor:
        """One step of the law, projected onto the bounds; (..., n_b) m.

        Args:
            pi_hat: (..., n_b) present estimate, m.
            Y: (..., 3, n_b) regressor.
            e: (..., 3) position error, m.
            dt: (...) step, s.
            other: (..., n_b) what another law adds to the velocity, m/s; None for nothing.
        """
        check_tensor("pi_hat", pi_hat, (self.gamma.shape[-1],))
        velocity = self.velocity(Y, e)
        step = pi_hat + dt.unsqueeze(-1) * (velocity if other is None else velocity + other)
        # A step that is not finite is not taken: one bad measurement must not lose what was learnt.
        return self.project(torch.where(torch.isfinite(step), step, pi_hat))

    def project(self, pi_hat: Tensor) -> Tensor:
        """The nearest allowed parameters (..., n_b): bounds per section, then the reach."""
        if self.lower is not None:
            pi_hat = torch.maximum(pi_hat, self.lower.to(pi_hat))
        if self.upper is not None:
            pi_hat = torch.minimum(pi_hat, self.upper.to(pi_hat))
        if self.reach is not None:
            # Half-space by half-space, the projection in the norm of Gamma^-1, in which V of Eq. (18) measures: it
            # brings pi_hat nearer to every pi that reaches as far, so the proof's V still falls.
            gamma, reach = self.gamma.to(pi_hat), self.reach.to(pi_hat)
            for i in self._reaching:
                toward = gamma[..., :i].sum(-1)
                short = (reach[..., i - 1 : i] - pi_hat[..., :i].sum(-1, keepdim=True)).clamp(min=0.0)
                pi_hat = pi_hat + short * toward / toward[..., :i].sum(-1, keepdim=True)
        return pi_hat


def _cumulative_reach(reach: float | Tensor, n_sections: int) -> Tensor:
    """(..., n_b) least ends of the sections, m; a number is the last one's."""
    if not isinstance(reach, Tensor):
        last = torch.tensor([float(reach)], dtype=torch.float64)
        reach = torch.cat((torch.zeros(n_sections - 1, dtype=torch.float64), last))
    check_finite("reach", check_tensor("reach", reach, (n_sections,)))
    if not (holds(reach >= 0) and holds(reach.diff() >= 0) and holds(reach[..., -1] > 0)):
        raise ValueRangeError(f"reach must be not negative, not decreasing and end positive, got {reach.tolist()}")
    return reach
