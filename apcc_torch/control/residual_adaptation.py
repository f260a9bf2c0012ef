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

from typing import NamedTuple

import torch
from torch import Tensor

from apcc_torch.control.bounds import scaled_within
from apcc_torch.errors import ConfigError, ValueRangeError
from apcc_torch.estimation.sensor_curve import SensorCurve
from apcc_torch.lie import se3
from apcc_torch.linalg import solve_spd
from apcc_torch.model.abscissae import located
from apcc_torch.model.kinematic_model import KinematicModel
from apcc_torch.modes import holds
from apcc_torch.part import Part, check_settings, check_settings_or_zero, hold, hold_rows
from apcc_torch.settings import Setting, aligned, is_used
from apcc_torch.shapes import check_finite, check_tensor

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


class ResidualLaw(Part):
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
        target: "curve" or "sensors".
        curve: For target "curve".
        angular_weight: For target "sensors", metres that a radian counts as; 0 for positions alone.
        time_constant: tau, s.
        elongation_weight: mu.
        nominal_weight: kappa.
        total_weight: sigma.
        damping: lambda, m/m: directions in which the residual moves by less per metre are followed slowly.
        excitation: Directions of the data in which the residual moves by less than this, m/m, are not followed at all.
        memory: s over which past residuals count; 0 for the present one alone.
        rate: Largest speed of a parameter, m/s. A row over it is scaled whole.
        gains: (..., n_b) factor on each section's speed; None for one.

    Raises:
        ConfigError: The target needs a curve and has none.
        ValueRangeError: A setting is out of range.
    """

    nominal: Tensor
    gains: Tensor
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

    def __init__(
        self,
        nominal: Tensor,
        target: str = "curve",
        curve: SensorCurve | None = None,
        angular_weight: Setting = 0.0,
        time_constant: Setting = 0.3,
        elongation_weight: Setting = 0.05,
        nominal_weight: Setting = 0.02,
        total_weight: Setting = 0.0,
        damping: Setting = 0.05,
        excitation: Setting = 0.0,
        memory: Setting = 0.0,
        rate: Setting = 0.1,
        gains: Tensor | None = None,
    ) -> None:
        super().__init__()
        if target not in TARGETS:
            raise ValueRangeError(f"target must be one of {', '.join(TARGETS)}, got {target!r}")
        if target == "curve" and curve is None:
            raise ConfigError("target curve needs a curve")
        positive = {"time_constant": time_constant, "damping": damping, "rate": rate}
        weights = {
            "angular_weight": angular_weight,
            "elongation_weight": elongation_weight,
            "nominal_weight": nominal_weight,
            "total_weight": total_weight,
            "excitation": excitation,
            "memory": memory,
        }
        check_settings(**positive)
        check_settings_or_zero(**weights)
        check_finite("nominal", check_tensor("nominal", nominal, (None,)))
        gains = torch.ones_like(nominal) if gains is None else check_tensor("gains", gains, (nominal.shape[-1],))
        if not holds(check_finite("gains", gains) >= 0):
            raise ValueRangeError(f"gains must be zero or positive, got {gains.tolist()}")
        self.target = target
        self.curve = curve
        hold(self, **positive, **weights)
        # Read once, for a compiled step has no branches on values.
        self.oriented, self.monitored, self.remembers = (is_used(v) for v in (angular_weight, excitation, memory))
        hold_rows(self, nominal=(nominal, 1), gains=(gains, 1))

    @property
    def needs_orientations(self) -> bool:
        """Whether the residual is made of measured orientations too."""
        return self.oriented if self.curve is None else self.curve.tangents == "measured"

    def initial_evidence(self, q: Tensor, pi_hat: Tensor) -> Evidence | None:
        """No evidence yet, of the batch of q (..., n) and pi_hat (..., n_b); None for a law without memory."""
        if not self.remembers:
            return None
        n_b = pi_hat.shape[-1]
        pi_hat = pi_hat.expand(*torch.broadcast_shapes(q.shape[:-1], pi_hat.shape[:-1]), n_b)
        return Evidence(torch.diag_embed(torch.zeros_like(pi_hat)), torch.zeros_like(pi_hat))

    def residual(
        self, backbone: KinematicModel, q: Tensor, pi: Tensor, followed: Tensor, T: Tensor, abscissae: Tensor
    ) -> Residual:
        """The target's residual at (q, pi), all of one leading shape; unchecked.

        Args:
            backbone: The model.
            q: (..., n) q_bar.
            pi: (..., n_b) m.
            followed: (..., n, n_b) dq_bar/dpi, from `StateFeedback.sensitivity`.
            T: (..., k, 4, 4) measured poses.
            abscissae: (k,) of the sensors, m.
        """
        X = (abscissae if self.curve is None else self.curve.abscissae).to(pi)
        X = X.expand(*pi.shape[:-1], X.shape[-1])
        points = backbone.material_points(pi, *located(X, pi))
        chain = backbone.chain_to(q, points)
        body = chain.body_jacobian()
        moved = body @ followed.unsqueeze(-3) + backbone.parameter_columns(q, pi, X, points, body)
        if self.curve is None:
            twist = se3.log(se3.inverse(se3.pose(chain.rotation, chain.tip)) @ T)
            angular = aligned(self.angular_weight, 2)
            weight = torch.ones_like(twist)
            weight = torch.cat((angular * weight[..., :3], weight[..., 3:]), dim=-1)
            return Residual((twist * weight).flatten(-2), (moved * weight.unsqueeze(-1)).flatten(-3, -2))
        return Residual(self.curve.across(chain, T).flatten(-2), moved[..., 3:5, :].flatten(-3, -2))

    def forward(
        self,
        backbone: KinematicModel,
        q: Tensor,
        pi: Tensor,
        followed: Tensor,
        T: Tensor,
        abscissae: Tensor,
        dt: Tensor,
        seen: Tensor,
        evidence: Evidence | None = None,
    ) -> tuple[Tensor, Evidence | None]:
        """pi_hat_dot (..., n_b), m/s, and the evidence after this sample; zero in rows that are not seen or not finite.

        Args:
            backbone, q, pi, followed, T, abscissae: As in `residual`.
            dt: (...) s since the last sample.
            seen: (...) bool, rows all of whose sensors count.
            evidence: From `initial_evidence` or the last step.
        """
        r, A = self.residual(backbone, q, pi, followed, T, abscissae)
        m = r.shape[-1]
        H, g = A.mT @ A / m, (A.mT @ r.unsqueeze(-1)).squeeze(-1) / m
        good = seen & torch.isfinite(g).all(-1) & torch.isfinite(H).all(-1).all(-1)
        H, g = torch.where(good[..., None, None], H, 0.0), torch.where(good[..., None], g, 0.0)
        if evidence is not None:
            keep = torch.exp(-dt / self.memory)
            H = torch.lerp(H, evidence.information, keep[..., None, None])
            g = torch.lerp(g, evidence.gradient, keep[..., None])
        H_data, g_data = H, g
        if self.monitored:
            values, directions = torch.linalg.eigh(H)
            followed_ones = directions * (values > aligned(self.excitation, 1) ** 2).to(H.dtype).unsqueeze(-2)
            g = (followed_ones @ (directions.mT @ g.unsqueeze(-1))).squeeze(-1)
        step = self._step(backbone, H, g, q, pi, followed)
        velocity = scaled_within(self.gains.to(pi) * step / aligned(self.time_constant, 1), self.rate)
        velocity = torch.where(good.unsqueeze(-1), velocity, 0.0)
        if evidence is None:
            return velocity, None
        moved = (H_data @ (dt.unsqueeze(-1) * velocity).unsqueeze(-1)).squeeze(-1)
        return velocity, Evidence(H_data, g_data - moved)

    def _step(self, backbone: KinematicModel, H: Tensor, g: Tensor, q: Tensor, pi: Tensor, followed: Tensor) -> Tensor:
        """The damped Gauss-Newton step of V (..., n_b), m."""
        n_b = pi.shape[-1]
        weights = (self.elongation_weight, self.nominal_weight, self.total_weight, self.damping)
        mu2, kappa2, sigma2, lambda2 = (aligned(weight, 2) ** 2 for weight in weights)
        identity = torch.eye(n_b, dtype=pi.dtype, device=pi.device)
        short = self.nominal.to(pi) - pi
        elongations = backbone.coordinates.elongations
        stretched = followed[..., elongations, :]
        H = H + mu2 * (stretched.mT @ stretched) + (kappa2 + lambda2) * identity + sigma2
        short = short.unsqueeze(-1)
        g = g.unsqueeze(-1) - mu2 * (stretched.mT @ q[..., elongations].unsqueeze(-1))
        g = g + kappa2 * short + sigma2 * short.sum(-2, keepdim=True)
        return solve_spd(H, g).squeeze(-1)
