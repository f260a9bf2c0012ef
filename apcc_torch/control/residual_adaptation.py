"""Adaptation from what the sensors leave unexplained: the rest lengths follow a residual that feedback cannot hide.

The task error of Eq. (15) is made small by feedback whatever the rest lengths are, so on a loaded arm it says little
about them. The residual between the model and the sensors stays. Algorithm 2 removes what the configuration can, so a
residual r of the model at (q_bar(pi), pi) changes with the total derivative

    A = dr/dq dq_bar/dpi + dr/dpi,

and the law takes Gauss-Newton steps of

    V(pi) = |r|^2 / m + mu^2 |dL|^2 + kappa^2 |pi - pi_0|^2 + sigma^2 (sum pi - sum pi_0)^2:

the residual, the elongations Psi that the model needs, and two priors, on the nominal lengths and on their sum.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, NamedTuple

import torch
from torch import Tensor

from apcc_torch.control.bounds import scaled_within
from apcc_torch.control.length_law import LawStep, LengthLaw
from apcc_torch.estimation.sensor_curve import SensorCurve, SensorCurveSettings
from apcc_torch.estimation.state_feedback import StateFeedback
from apcc_torch.lie import se3
from apcc_torch.linalg import solve_spd
from apcc_torch.model.abscissae import located
from apcc_torch.part import hold_rows
from apcc_torch.settings import OURS, Setting, aligned, is_on, resolved, setting
from apcc_torch.shapes import check_finite, check_tensor
from apcc_torch.spread import Numbers, spread

TARGETS = ("curve", "sensors")


class Evidence(NamedTuple):
    """What past residuals say: their quadratic model around the present parameters, forgotten with time.

    information: (..., n_b, n_b). gradient: (..., n_b), m.
    """

    information: Tensor
    gradient: Tensor


class Residual(NamedTuple):
    """A residual r (..., m) and its total derivative A (..., m, n_b) with respect to the rest lengths."""

    value: Tensor
    derivative: Tensor


@dataclass(frozen=True, kw_only=True)
class ResidualLawSettings(SensorCurveSettings):
    """Settings of `ResidualLaw`."""

    target: str = setting(
        "curve",
        "",
        OURS,
        "curve, distances to a curve through the sensors; sensors, their own residuals",
        choices=TARGETS,
    )
    angular_weight: Setting = setting(
        0.0, "m/rad", OURS, "of target sensors; 0: positions alone", rows="number", least=0, apart=True
    )
    time_constant: Setting = setting(
        10.0, "s", OURS, "in which a step of the rest lengths is made", rows="number", above=0
    )
    elongation_weight: Setting = setting(
        0.0, "", OURS, "mu, how much elongation weighs against residual", rows="number", least=0
    )
    nominal_weight: Setting = setting(0.0, "", OURS, "kappa, pull towards the first estimate", rows="number", least=0)
    total_weight: Setting = setting(
        0.0, "", OURS, "sigma, pull of the total length towards the first estimate's", rows="number", least=0
    )
    damping: Setting = setting(
        0.05, "m/m", OURS, "directions in which the residual moves less are followed slowly", rows="number", above=0
    )
    excitation: Setting = setting(
        0.0, "m/m", OURS, "directions in which it moves less are not followed", rows="number", least=0, apart=True
    )
    memory: Setting = setting(
        0.0, "s", OURS, "over which past residuals count; 0: the present one", rows="number", least=0, apart=True
    )
    rate: Setting = setting(0.1, "m/s", OURS, "largest speed of a parameter", rows="number", above=0)
    gains: Numbers | None = setting(
        None, "", OURS, "a factor on each section's speed; null: one", rows="sections", least=0
    )


class ResidualLaw(LengthLaw):
    """pi_hat_dot = (H + lambda^2 I)^-1 g / tau, a Gauss-Newton flow of V; see the module's head.

    Targets:

    - "curve": distances, across the backbone, between the model and the `SensorCurve`. Between the sensors the curve
      knows the true shape better than any single arc does, and where the sections end is what decides how well arcs can
      follow it.
    - "sensors": the weighted residual of algorithm 2 itself. Where algorithm 2 has converged, J_b^T W r = 0, so the
      gradient A^T r is the partial one, and with `memory` the law is the joint least-squares estimate of (q, pi) over a
      window, pi a random walk: an extended Kalman filter whose fast states are eliminated at every sample.

    Each number may also be a tensor (...), one a row, but for one that zero turns off: all rows have it, or none.

    Args:
        nominal: (..., n_b) pi_0, m.
        feedback: Algorithm 2, of the controller's own settings.
        *settings, **changes: See `ResidualLawSettings`.

    Raises:
        ConfigError, ValueRangeError: A setting is wrong or out of range.

    Example:
        >>> nominal = torch.tensor([0.2, 0.25]).double()
        >>> law = ResidualLaw(nominal, StateFeedback(PCCBackbone(2), nominal.cumsum(0)), time_constant=1.0)
        >>> law.initial_memory(torch.zeros(6).double(), nominal) is None
        True
    """

    settings_type = ResidualLawSettings
    nominal: Tensor
    gains: Tensor
    target: str
    angular_weight: Setting
    time_constant: Setting
    elongation_weight: Setting
    nominal_weight: Setting
    total_weight: Setting
    damping: Setting
    excitation: Setting
    memory: Setting
    rate: Setting
    needs_sensitivity = True
    needs_velocity = False

    def __init__(self, nominal: Tensor, feedback: StateFeedback, *settings: Any, **changes: Any) -> None:
        super().__init__()
        s = resolved(ResidualLawSettings, settings, changes)
        check_finite("nominal", check_tensor("nominal", nominal, (None,)))
        self.hold(s)
        self.curve = curve_of(feedback, s) if s.target == "curve" else None
        gains = torch.ones_like(nominal) if s.gains is None else spread("gains", s.gains, nominal.shape[-1])
        hold_rows(self, nominal=(nominal, 1), gains=(gains, 1))

    @property
    def oriented(self) -> bool:
        """Whether the residual is made of measured orientations too."""
        return is_on(self.angular_weight) if self.curve is None else self.curve.tangents == "measured"

    def initial_memory(self, q: Tensor, pi_hat: Tensor) -> Evidence | None:
        """No evidence yet, of the batch of q (..., n) and pi_hat (..., n_b); None for a law without memory."""
        if not is_on(self.memory):
            return None
        n_b = pi_hat.shape[-1]
        pi_hat = pi_hat.expand(*torch.broadcast_shapes(q.shape[:-1], pi_hat.shape[:-1]), n_b)
        return Evidence(torch.diag_embed(torch.zeros_like(pi_hat)), torch.zeros_like(pi_hat))

    def residual(self, step: LawStep) -> Residual:
        """The target's residual at (q_bar, pi_hat); unchecked."""
        backbone, q, pi, dq_dpi, T = step.backbone, step.q_bar, step.pi_hat, step.dq_dpi, step.T
        assert dq_dpi is not None  # asked for by `needs_sensitivity`
        X = (step.abscissae if self.curve is None else self.curve.abscissae).to(pi)
        X = X.expand(*pi.shape[:-1], X.shape[-1])
        points = backbone.material_points(pi, *located(X, pi))
        chain = backbone.chain_to(q, points)
        body = chain.body_jacobian()
        moved = body @ dq_dpi.unsqueeze(-3) + backbone.parameter_columns(q, pi, X, points, body)
        if self.curve is None:
            twist = se3.log(se3.inverse(se3.pose(chain.rotation, chain.tip)) @ T)
            angular = aligned(self.angular_weight, 2)
            weight = torch.ones_like(twist)
            weight = torch.cat((angular * weight[..., :3], weight[..., 3:]), dim=-1)
            return Residual((twist * weight).flatten(-2), (moved * weight.unsqueeze(-1)).flatten(-3, -2))
        return Residual(self.curve.across(chain, T).flatten(-2), moved[..., 3:5, :].flatten(-3, -2))

    def speed(self, step: LawStep, memory: Evidence | None) -> tuple[Tensor, Evidence | None]:
        """See `LengthLaw.speed`; zero in rows not all of whose sensors count, or that are not finite."""
        r, A = self.residual(step)
        m = r.shape[-1]
        H, g = A.mT @ A / m, (A.mT @ r.unsqueeze(-1)).squeeze(-1) / m
        good = step.complete(self.oriented) & torch.isfinite(g).all(-1) & torch.isfinite(H).all(-1).all(-1)
        H, g = torch.where(good[..., None, None], H, 0.0), torch.where(good[..., None], g, 0.0)
        if memory is not None:
            keep = torch.exp(-step.dt / self.memory)
            H = torch.lerp(H, memory.information, keep[..., None, None])
            g = torch.lerp(g, memory.gradient, keep[..., None])
        H_data, g_data = H, g
        if is_on(self.excitation):
            values, directions = torch.linalg.eigh(H)
            excited = directions * (values > aligned(self.excitation, 1) ** 2).to(H.dtype).unsqueeze(-2)
            g = (excited @ (directions.mT @ g.unsqueeze(-1))).squeeze(-1)
        change = self._change(step, H, g)
        velocity = scaled_within(self.gains.to(change) * change / aligned(self.time_constant, 1), self.rate)
        velocity = torch.where(good.unsqueeze(-1), velocity, 0.0)
        if memory is None:
            return velocity, None
        moved = (H_data @ (step.dt.unsqueeze(-1) * velocity).unsqueeze(-1)).squeeze(-1)
        return velocity, Evidence(H_data, g_data - moved)

    def _change(self, step: LawStep, H: Tensor, g: Tensor) -> Tensor:
        """The damped Gauss-Newton step of V (..., n_b), m."""
        q, pi, dq_dpi = step.q_bar, step.pi_hat, step.dq_dpi
        assert dq_dpi is not None  # asked for by `needs_sensitivity`
        n_b = pi.shape[-1]
        weights = (self.elongation_weight, self.nominal_weight, self.total_weight, self.damping)
        mu2, kappa2, sigma2, lambda2 = (aligned(weight, 2) ** 2 for weight in weights)
        identity = torch.eye(n_b, dtype=pi.dtype, device=pi.device)
        short = self.nominal.to(pi) - pi
        elongations = step.backbone.coordinates.elongations
        stretched = dq_dpi[..., elongations, :]
        H = H + mu2 * (stretched.mT @ stretched) + (kappa2 + lambda2) * identity + sigma2
        short = short.unsqueeze(-1)
        g = g.unsqueeze(-1) - mu2 * (stretched.mT @ q[..., elongations].unsqueeze(-1))
        g = g + kappa2 * short + sigma2 * short.sum(-2, keepdim=True)
        return solve_spd(H, g).squeeze(-1)


def curve_of(feedback: StateFeedback, settings: SensorCurveSettings) -> SensorCurve:
    """The curve through a controller's sensors, with their axes as tangents where algorithm 2 uses them too."""
    tangents = settings.tangents or ("spline" if feedback.mode == "position" else "measured")
    return SensorCurve(feedback.backbone.base_rotation, feedback.abscissae, tangents, settings.samples)
