"""Adaptation of the dynamics: rigidities, tendon friction and payload follow what the arm does and what it takes.

Composite adaptation after Slotine and Li: two errors speak of theta. The tracking error s, the velocity off a reference
velocity, moves theta so that the feed-forward Y_d theta_hat makes s vanish; the prediction error, filtered tendon
forces against those that theta_hat would need for the motion that was measured, moves it towards the truth:

    theta_hat_dot = -P (g Y_d^T s + W^T Q (W theta_hat - tau_f)),
    d/dt P^-1 = -(P^-1 - P_0^-1) / T_m + W^T Q W.

W and tau_f are Y_d(q, qdot, qdot, qddot) and B u, both behind the low-pass 1 / (T_f s + 1): of an acceleration, or of
a velocity, it passes on what a difference quotient says, so no acceleration is measured. The gain P is forgotten
towards the prior's P_0, which bounds it from above whatever the excitation is; without forgetting it falls as in least
squares.

Where the model is the arm and e = q - q_d,

    V = g (s^T M s + e^T K e) / 2 + (theta_hat - theta)^T P^-1 (theta_hat - theta) / 2

does not increase, s goes to zero, and theta_hat converges in the directions that W excites.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, NamedTuple

import torch
from torch import Tensor

from apcc_torch.errors import ValueRangeError
from apcc_torch.linalg import solve_spd
from apcc_torch.model.dynamics_regressor import PARAMETERS
from apcc_torch.modes import holds, none_left
from apcc_torch.part import Part, hold_rows
from apcc_torch.settings import OURS, Settings, resolved, setting
from apcc_torch.shapes import check_finite, check_same, check_tensor


class DynamicsEstimate(NamedTuple):
    """What the law remembers.

    theta_hat: (..., 5) estimates, in the order and the units of `PARAMETERS`.
    information: (..., 5, 5) P^-1, of parameters in units of their deviations.
    regressor: (..., n, 5) W, N m, N m, N a section, per unit of the parameter.
    tau: (..., n) tau_f, N m, N m, N a section.
    """

    theta_hat: Tensor
    information: Tensor
    regressor: Tensor
    tau: Tensor


@dataclass(frozen=True, kw_only=True)
class AdaptiveDynamicsSettings(Settings):
    """Settings of `AdaptiveDynamics`."""

    tracking_gain: float = setting(1.0, "1/J", OURS, "g, what the tracking error counts", least=0)
    prediction: bool = setting(True, "", OURS, "whether the prediction error counts")
    filter_time: float = setting(
        0.3, "s", OURS, "T_f, low-pass on forces and regressor, so that no acceleration is measured", above=0
    )
    memory: float = setting(
        2.0, "s", OURS, "T_m, over which the past counts; infinite for all of it", above=0, infinite=True
    )
    torque_noise: float = setting(0.2, "N m", OURS, "deviation of forces that the model does not explain", above=0)
    length: float = setting(0.1, "m", OURS, "by which a force counts as a torque", above=0)
    dead_zone: float = setting(0.0, "N m", OURS, "prediction error up to which nothing is learnt from it", least=0)


class AdaptiveDynamics(Part):
    """The law of theta; see the module's head. Q is the inverse square of the torque noise, counted once a filter time.

    Args:
        nominal: (..., 5) first estimates, as `PARAMETERS`.
        deviation: (..., 5) how far off each may be: the square root of P_0. A parameter of deviation zero is known.
        lower: (..., 5) smallest values; None for zero, and a tenth of nominal for the rigidities.
        upper: (..., 5) largest values; None for no bounds.
        *settings, **changes: See `AdaptiveDynamicsSettings`.

    Raises:
        ShapeError: A tensor is not (..., 5).
        ValueRangeError: A setting is out of range, bounds cross, or the first estimate is not within them.

    Example:
        >>> nominal = torch.tensor([0.08, 10.0, 200.0, 0.0, 1.0])
        >>> law = AdaptiveDynamics(nominal, torch.tensor([0.02, 3.0, 50.0, 0.3, 0.0]))
        >>> law.initial_estimate(torch.zeros(9)).theta_hat
        tensor([8.0000e-02, 1.0000e+01, 2.0000e+02, 0.0000e+00, 1.0000e+00])
    """

    settings_type = AdaptiveDynamicsSettings
    nominal: Tensor
    deviation: Tensor
    lower: Tensor
    upper: Tensor
    tracking_gain: float
    prediction: bool
    filter_time: float
    memory: float
    torque_noise: float
    length: float
    dead_zone: float

    def __init__(
        self,
        nominal: Tensor,
        deviation: Tensor,
        lower: Tensor | None = None,
        upper: Tensor | None = None,
        *settings: Any,
        **changes: Any,
    ) -> None:
        super().__init__()
        p = len(PARAMETERS)
        check_finite("nominal", check_tensor("nominal", nominal, (p,)))
        check_finite("deviation", check_tensor("deviation", deviation, (p,)))
        if lower is None:
            # A bound is no way to train what it bounds.
            lower = nominal.detach() * nominal.new_tensor([0.1, 0.1, 0.0, 0.0, 0.0])
        if upper is None:
            upper = torch.full_like(nominal, torch.inf)
        for name, bound in {"lower": lower, "upper": upper}.items():
            check_tensor(name, bound, (p,))
        check_same(nominal=nominal, deviation=deviation, lower=lower, upper=upper)
        if not holds(deviation >= 0):
            raise ValueRangeError(f"deviation must be zero or positive, got {deviation.tolist()}")
        if not holds((lower <= nominal) & (nominal <= upper) & (lower < upper)):
            raise ValueRangeError("nominal must be between lower and upper, and lower below upper, for every parameter")
        if not holds(lower >= 0):
            raise ValueRangeError("lower must not be negative: no parameter of the dynamics is")
        self.hold(resolved(AdaptiveDynamicsSettings, settings, changes))
        hold_rows(self, nominal=(nominal, 1), deviation=(deviation, 1), lower=(lower, 1), upper=(upper, 1))
        self._uncertain = [i for i in range(p) if not none_left(deviation[..., i] > 0)]

    def initial_estimate(self, q: Tensor) -> DynamicsEstimate:
        """The nominal parameters, before anything was seen of configurations q (..., n)."""
        p = self.nominal.shape[-1]
        zero = torch.zeros_like(q)
        identity = torch.eye(p, dtype=q.dtype, device=q.device)
        return DynamicsEstimate(
            self.nominal.to(q).expand(*q.shape[:-1], p),
            identity.expand(*q.shape[:-1], p, p),
            zero.unsqueeze(-1).expand(*q.shape, p),
            zero,
        )

    def prediction_error(self, estimate: DynamicsEstimate) -> Tensor:
        """W theta_hat - tau_f (..., n), N m, N m, N a section."""
        return (estimate.regressor @ estimate.theta_hat.unsqueeze(-1)).squeeze(-1) - estimate.tau

    def forward(
        self, estimate: DynamicsEstimate, Y: Tensor, s: Tensor, measured: Tensor, tau: Tensor, dt: Tensor
    ) -> DynamicsEstimate:
        """One step of the law, projected onto the bounds.

        Args:
            estimate: From `initial_estimate` or the last step.
            Y: (..., n, 5) Y_d of the feed-forward.
            s: (..., n) velocity off the reference velocity.
            measured: (..., n, 5) Y_d(q, qdot, qdot, qddot) of the motion that was measured.
            tau: (..., n) generalized tendon force B u that was measured; a row that is not finite teaches nothing.
            dt: (...) s since the last step.
        """
        n, p = tau.shape[-1], self.nominal.shape[-1]
        check_tensor("Y", Y, (n, p))
        check_tensor("measured", measured, (n, p))
        check_tensor("s", s, (n,))
        check_same(Y=Y, measured=measured, s=s, tau=tau)
        deviation = self.deviation.to(tau)
        seen = torch.isfinite(tau).all(-1) & torch.isfinite(measured).all(-1).all(-1)
        filtered = self._filtered(estimate, measured, tau, dt, seen)
        weight = self._weight(tau)
        error = weight * self.prediction_error(filtered)
        trust = self._trust(error, dt, seen)
        scaled = weight.unsqueeze(-1) * filtered.regressor * deviation.unsqueeze(-2)
        identity = torch.eye(p, dtype=tau.dtype, device=tau.device)
        keep = torch.exp(-dt / self.memory)[..., None, None]
        information = torch.lerp(identity, estimate.information, keep) + trust[..., None, None] * (scaled.mT @ scaled)
        descent = trust.unsqueeze(-1) * (scaled.mT @ error.unsqueeze(-1)).squeeze(-1)
        if self.tracking_gain > 0.0:
            pushed = deviation * (Y.mT @ s.unsqueeze(-1)).squeeze(-1)
            descent = descent + (self.tracking_gain * dt).unsqueeze(-1) * pushed
        gain = solve_spd(information, identity)
        theta = estimate.theta_hat - deviation * (gain @ descent.unsqueeze(-1)).squeeze(-1)
        # A step that is not finite is not taken: one bad measurement must not lose what was learnt.
        good = torch.isfinite(theta).all(-1) & torch.isfinite(information).all(-1).all(-1)
        theta = torch.where(good.unsqueeze(-1), self._projected(theta, gain), estimate.theta_hat)
        information = torch.where(good[..., None, None], information, estimate.information)
        return filtered._replace(theta_hat=theta, information=information)

    def _filtered(
        self, estimate: DynamicsEstimate, measured: Tensor, tau: Tensor, dt: Tensor, seen: Tensor
    ) -> DynamicsEstimate:
        """The estimate with W and tau_f one sample later, in the rows that are seen."""
        share = (1.0 - torch.exp(-dt / self.filter_time)).unsqueeze(-1)
        W = torch.lerp(estimate.regressor, measured, share.unsqueeze(-1))
        W = torch.where(seen[..., None, None], W, estimate.regressor)
        tau_f = torch.where(seen.unsqueeze(-1), torch.lerp(estimate.tau, tau, share), estimate.tau)
        return estimate._replace(regressor=W, tau=tau_f)

    def _trust(self, error: Tensor, dt: Tensor, seen: Tensor) -> Tensor:
        """What this sample's prediction error (..., n) counts, (...) 1/(N m)^2; less and less into the dead zone."""
        one = torch.ones_like(error[..., 0])
        if self.dead_zone > 0.0:
            # Error and information shrink alike: the gain falls no faster than is learnt, and V still does not rise.
            one = (1.0 - self.dead_zone / error.square().sum(-1).clamp(min=1e-30).sqrt()).clamp(min=0.0)
        counted = float(self.prediction) * dt / (self.filter_time * self.torque_noise**2)
        return torch.where(seen, one, 0.0) * counted

    def _weight(self, like: Tensor) -> Tensor:
        """(n,) one for torques, `length` for forces."""
        bends = torch.ones(like.shape[-1] // 3, 2, dtype=like.dtype, device=like.device)
        return torch.cat((bends, self.length * bends[:, :1]), dim=-1).flatten()

    def _projected(self, theta: Tensor, gain: Tensor) -> Tensor:
        """theta (..., 5) within the bounds: one after the other, by the projection in the norm of P^-1 that V has."""
        lower, upper, deviation = (bound.to(theta) for bound in (self.lower, self.upper, self.deviation))
        for i in self._uncertain:
            # Nearer to every theta within the bound, so V still falls.
            over = theta[..., i] - torch.minimum(torch.maximum(theta[..., i], lower[..., i]), upper[..., i])
            own = (deviation[..., i] * gain[..., i, i]).clamp(min=1e-30)
            theta = theta - (over / own).unsqueeze(-1) * deviation * gain[..., i]
        return torch.minimum(torch.maximum(theta, lower), upper)
