"""Payload and external force from the tendons' tensions and the shape: the model's static balance, linear in the force.

    G(q_bar) + K q_bar - B_hat u = J(X)^T f

What the shape asks for and the tendons do not give, something outside gives. Every term that is not exact makes noise:
the sensors through q_bar, the tension sensors, and the model, whose sections are not the arm's.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from apcc_torch.errors import ConfigError
from apcc_torch.estimation.feedback_covariance import feedback_covariance
from apcc_torch.estimation.posture import Posture, TendonMechanics
from apcc_torch.estimation.state_feedback import StateFeedback
from apcc_torch.estimation.weighted_estimate import WeightedEstimate, weighted_estimate
from apcc_torch.model.static_body import StaticBody
from apcc_torch.model.tendons import TendonRouting
from apcc_torch.modes import full_precision
from apcc_torch.part import Part, hold_numbers, hold_rows
from apcc_torch.settings import Setting, aligned, check_setting
from apcc_torch.shapes import batch_shape, check_tensor

# Of a tendon whose tension nobody measures, N: so wide that it weighs nothing.
UNKNOWN_TENSION = 100.0


class BalanceNoise(NamedTuple):
    """Standard deviations of what enters the balance; numbers, or (...) one a row.

    position: Of each coordinate of a sensor, m. angle: Of each component of its rotation vector, rad.
    tension: Of each tendon's force, N.
    bend, slope, length: Generalized force by which the model is wrong, on bends, torsion and slopes N m, and on
        lengths N. They count for every coordinate apart; `Tare` measures them.

    Example:
        >>> BalanceNoise(position=1e-3).tension
        0.05
    """

    position: Setting = 2e-4
    angle: Setting = 8.726646e-3
    tension: Setting = 0.05
    bend: Setting = 0.02
    length: Setting = 0.2


class Tare(NamedTuple):
    """What the balance of the unloaded arm leaves, from `tare`.

    offset: (..., n) its mean. covariance: (..., n, n) its spread: how wrong the model is.
    """

    offset: Tensor
    covariance: Tensor


@full_precision
def tare(imbalance: Tensor, floor: Tensor) -> Tare:
    """The offset and the spread of an unloaded arm's balance over N postures.

    Args:
        imbalance: (N, n) from `ForceBalance.imbalance`; N may be 1: the tare of one posture.
        floor: (n,) least standard deviation.

    Example:
        >>> left = torch.tensor([[0.1, 0.2], [0.3, 0.2]])
        >>> tare(left, floor=torch.tensor([0.01, 0.01])).offset
        tensor([0.2000, 0.2000])
    """
    check_tensor("imbalance", imbalance, (None, None))
    offset = imbalance.mean(0)
    apart = imbalance - offset
    covariance = apart.mT @ apart / max(1, len(imbalance) - 1)
    return Tare(offset, covariance + torch.diag_embed(floor**2))


class ForceBalance(Part):
    """Estimates what acts on an arm at rest, or in slow motion, with covariance and status.

    Without tensions (`Posture.u` None) only what tendons cannot give tells the load: nothing where they drive every
    coordinate, as nine tendons do three sections of constant curvature; with slopes (`AffineBackbone`) much of it.

    Args:
        body: Weight and elasticity of the model.
        routing: Its tendons.
        feedback: What q_bar comes from.
        noise: What is not exact.
        damping_ratio: Forces of the material's damping are damping_ratio K qdot, s; they count where qdot is given.
        tendon_damping: Viscous friction of each tendon in its guides, N s/m, likewise.
        tip: Material abscissa of a payload, m; None: the last sensor's.
        mechanics: Of the tendons, for `Posture.pulled` and `Posture.slide`; None: their forces are told, without
            friction.
        limit: Largest standard deviation of a force component that counts as determined, N.

    Raises:
        ConfigError: The feedback's model is not the body's; or, later, a posture tells what needs `mechanics`.
        ValueRangeError: A number is out of range.

    Example:
        >>> arm = Arm(lengths=[0.2, 0.25], mass=0.45)
        >>> body = StaticBody(arm.backbone(), density=1.0, axial=10.0, bending=0.0778)
        >>> balance = ForceBalance(body, arm.routing(), StateFeedback(arm.backbone(), arm.sensor_places()))
        >>> u = torch.zeros(6).double()
        >>> hanging = equilibrium(arm.dynamics(), payload=torch.tensor(0.1).double())
        >>> balance.payload(Posture(hanging.q, arm.rest_lengths(), u)).value
        tensor([0.1000], dtype=torch.float64)
    """

    position_noise: Setting
    angle_noise: Setting
    tension_noise: Setting
    bend_noise: Setting
    length_noise: Setting
    damping_ratio: Setting
    tendon_damping: Setting
    down: Tensor
    own_tip: Tensor | None

    def __init__(
        self,
        body: StaticBody,
        routing: TendonRouting,
        feedback: StateFeedback,
        noise: BalanceNoise | None = None,
        damping_ratio: Setting = 0.0,
        tendon_damping: Setting = 0.0,
        tip: float | None = None,
        limit: float = 5.0,
        mechanics: TendonMechanics | None = None,
    ) -> None:
        super().__init__()
        if feedback.backbone.n != body.backbone.n or type(feedback.backbone) is not type(body.backbone):
            raise ConfigError("feedback and body must have the same kinematic model")
        noise = BalanceNoise() if noise is None else noise
        for name, value in noise._asdict().items():
            check_setting(f"noise.{name}", value, zero=name in ("position", "angle", "tension"))
        self.body = body
        self.routing = routing
        self.feedback = feedback
        self.mechanics = mechanics
        self.limit = check_setting("limit", limit)
        hold_numbers(
            self,
            damping_ratio=check_setting("damping_ratio", damping_ratio, zero=True),
            tendon_damping=check_setting("tendon_damping", tendon_damping, zero=True),
            **{f"{name}_noise": value for name, value in noise._asdict().items()},
        )
        own = None if tip is None else torch.full_like(feedback.abscissae[..., -1:], tip)
        hold_rows(self, own_tip=(own, 1))
        down = torch.tensor([[0.0], [0.0], [-1.0]], dtype=torch.float64, device=feedback.abscissae.device)
        self.register_buffer("down", down, persistent=False)

    @property
    def tip(self) -> Tensor:
        """(..., 1) material abscissa of a payload, m."""
        return self.feedback.abscissae[..., -1:] if self.own_tip is None else self.own_tip

    def imbalance(self, posture: Posture, offset: Tensor | None = None) -> Tensor:
        """G + K q_bar - B u (..., n), less `offset`: what external forces must hold, N m and N."""
        q, pi, _, qdot, payload, *_ = exact = posture.double()
        r = self.body.rest_force(q, pi)
        B = self._tendons(pi)
        if payload is not None:
            lift = self.body.point_jacobians(q, pi, self.tip.to(q))[..., 0, 2, :]
            r = r + (payload * self.body.gravity_acceleration).unsqueeze(-1) * lift
        if qdot is not None:
            speed = (B.mT @ qdot.unsqueeze(-1)).squeeze(-1)
            drag = aligned(self.tendon_damping, 1) * speed
            r = r + aligned(self.damping_ratio, 1) * self.body.stiffness(pi) * qdot
            r = r + (B @ drag.unsqueeze(-1)).squeeze(-1)
        held = self._held(exact, q, B)
        if held is not None:
            r = r - held
        if offset is not None:
            r = r - offset.double()
        return r.to(posture.q_bar.dtype)

    def covariance(
        self,
        posture: Posture,
        X: Tensor | None = None,
        force: Tensor | None = None,
        tare: Tare | None = None,
        mask: Tensor | None = None,
        angular_mask: Tensor | None = None,
    ) -> Tensor:
        """Covariance (..., n, n) of `imbalance`.

        The noise of q_bar acts through the stiffness of elasticity and of gravity, and through that of the force
        itself, whose lever moves with the arm.

        Args:
            posture: The arm.
            X: (..., 1) material abscissa of the force, m; None without.
            force: (..., 3) about what it is, world axes, N.
            tare: The model's measured error, instead of `BalanceNoise.bend` and `length`.
            mask, angular_mask: (..., k) bool, as in `StateFeedback.forward`.
        """
        q, pi, u, _, payload, pulled, slide = exact = posture.double()
        points = []
        if payload is not None:
            weight = payload * self.body.gravity_acceleration
            points.append((self.tip.to(q), weight.unsqueeze(-1) * self.down.to(q).squeeze(-1)))
        if X is not None and force is not None:
            points.append((X.to(q), force.to(q)))
        A = self._slope(exact, points)
        Q = feedback_covariance(self.feedback, q, pi, self.position_noise, self.angle_noise, mask, angular_mask)
        B = self._tendons(pi)
        tension = UNKNOWN_TENSION if u is None and pulled is None else self.tension_noise
        loose = aligned(tension, 2) * (
            B if slide is None else self._told("slide").rubbed(B, self.routing, q, pi, slide)
        )
        S = A @ Q @ A.mT + loose @ loose.mT
        if tare is not None:
            S = S + tare.covariance.to(S)
        else:
            model = self.body.backbone.coordinates.per_unit(self.bend_noise, self.length_noise, q.shape[-1], q)
            S = S + torch.diag_embed(model * model)
        return S.to(posture.q_bar.dtype)

    def payload(
        self,
        posture: Posture,
        tare: Tare | None = None,
        covariance: Tensor | None = None,
        mask: Tensor | None = None,
        angular_mask: Tensor | None = None,
    ) -> WeightedEstimate:
        """Mass at the tip: value (..., 1), kg; arguments as `force`."""
        g = self.body.gravity_acceleration
        axis = self.down * g if isinstance(g, float) else self.down.to(g) * aligned(g, 2)
        return self._estimate(posture, self.tip, axis, tare, covariance, mask, angular_mask)

    def force(
        self,
        posture: Posture,
        X: Tensor | None = None,
        tare: Tare | None = None,
        covariance: Tensor | None = None,
        mask: Tensor | None = None,
        angular_mask: Tensor | None = None,
    ) -> WeightedEstimate:
        """Force at a known material abscissa: value (..., 3), world axes, N.

        Args:
            posture: The arm.
            X: (..., 1) m; None: the tip.
            tare: From the unloaded arm; None for none.
            covariance: (..., n, n) of the imbalance, from `covariance`; None computes it, with the force found first.
                In a fast loop it may be kept from step to step.
            mask, angular_mask: (..., k) bool, as in `StateFeedback.forward`.
        """
        axes = torch.eye(3, dtype=torch.float64, device=posture.q_bar.device)
        X = self.tip if X is None else check_tensor("X", X, (1,))
        return self._estimate(posture, X, axes, tare, covariance, mask, angular_mask)

    def columns(self, posture: Posture, X: Tensor, axes: Tensor) -> Tensor:
        """J(X)^T axes (..., k, n, p): generalized forces of unit forces along axes (3, p) at X (..., k)."""
        q, pi, *_ = posture.double()
        J = self.body.point_jacobians(q, pi, X.to(q))
        return (J.mT @ axes.to(q).unsqueeze(-3)).to(posture.q_bar.dtype)

    def _estimate(
        self,
        posture: Posture,
        X: Tensor,
        axes: Tensor,
        tare: Tare | None,
        covariance: Tensor | None,
        mask: Tensor | None,
        angular_mask: Tensor | None,
    ) -> WeightedEstimate:
        """In double precision: tensions that nobody measures weigh far less than measured ones."""
        exact = posture.double()
        r = self.imbalance(exact, None if tare is None else tare.offset)
        Phi = self.columns(exact, X, axes)[..., 0, :, :]
        limit = self.limit / axes.double().norm(dim=-2)
        if covariance is None:
            S = self.covariance(exact, X, None, tare, mask, angular_mask)
            first = weighted_estimate(r, Phi, S, limit).value
            force = (axes.to(r) @ torch.where(torch.isfinite(first), first, 0.0).unsqueeze(-1)).squeeze(-1)
            covariance = self.covariance(exact, X, force, tare, mask, angular_mask)
        result = weighted_estimate(r, Phi, covariance.double(), limit)
        return result.to(posture.q_bar.dtype)

    def _tendons(self, pi: Tensor) -> Tensor:
        own = self.routing.anchors.dtype
        return self.body.backbone.tendon_matrix(self.routing, pi.to(own)).to(pi.dtype)

    def _told(self, name: str) -> TendonMechanics:
        if self.mechanics is None:
            raise ConfigError(f"posture.{name} needs mechanics, the tendons' stiffness and friction, of the balance")
        return self.mechanics

    def _held(self, posture: Posture, q: Tensor, B: Tensor) -> Tensor | None:
        """Generalized force (..., n) of the tendons at q; None where nobody knows it."""
        u, pulled, slide = posture.u, posture.pulled, posture.slide
        if u is None:
            if pulled is None:
                return None
            u = self._told("pulled").forces(pulled, (B.mT @ q.unsqueeze(-1)).squeeze(-1))
        if slide is not None:
            B = self._told("slide").rubbed(B, self.routing, q, posture.pi_hat, slide)
        return (B @ u.unsqueeze(-1)).squeeze(-1)

    def _slope(self, posture: Posture, points: list[tuple[Tensor, Tensor]]) -> Tensor:
        """d(G + K q - B u - J^T f)/dq (..., n, n) of forces f at points, by central differences: it only weighs."""
        q, pi = posture.q_bar, posture.pi_hat
        n = q.shape[-1]
        batch = batch_shape(q=(q, 1), pi_hat=(pi, 1))
        h = torch.finfo(q.dtype).eps ** (1.0 / 3.0)
        steps = h * torch.eye(n, dtype=q.dtype, device=q.device)
        steps = torch.cat((steps, -steps)).view(2 * n, *[1] * len(batch), n)
        moved, still = q + steps, pi.expand(2 * n, *batch, pi.shape[-1])
        load = self.body.rest_force(moved, still)
        if posture.pulled is not None or posture.slide is not None:
            # Forces that are told are not moved by q; of tendons that stretch and rub they are.
            held = self._held(posture, moved, self._tendons(pi))
            load = load if held is None else load - held
        for X, f in points:
            J = self.body.point_jacobians(moved, still, X)[..., 0, :, :]
            load = load - (J.mT @ f.unsqueeze(-1)).squeeze(-1)
        up, down = load.split_with_sizes((n, n))
        return ((up - down) / (2.0 * h)).movedim(0, -1)
