"""The closed loop as a look-ahead predicts it: one step of arm, tendons and Eq. (16), with what it costs."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import torch
from torch import Tensor

from apcc_torch.control.bounds import ReferenceBounds
from apcc_torch.control.clearance import ClearanceCost
from apcc_torch.control.inverse_kinematics import InverseKinematics
from apcc_torch.control.lookahead_settings import PredictedLoopSettings
from apcc_torch.control.obstacles import Obstacle, Sphere
from apcc_torch.model.backbone import PCCBackbone
from apcc_torch.model.dynamics import SoftArmDynamics
from apcc_torch.model.integrators import Actuation, ArmState, semi_implicit_step
from apcc_torch.model.kinematic_model import Placed
from apcc_torch.model.tendons import TendonRouting
from apcc_torch.part import Part, hold_numbers, hold_rows
from apcc_torch.settings import Setting, resolved


class Predicted(NamedTuple):
    """An arm under way.

    q, qdot: (..., n_f) of the arm's pieces, rad, m, 1/s. q_d: (..., n) of the controller.
    y: (..., n_a) m commanded. e, edot: (..., 3) error of the tip that is asked for, m, m/s. time: (...) s from now.
    cost: (...) so far.
    """

    q: Tensor
    qdot: Tensor
    q_d: Tensor
    y: Tensor
    e: Tensor
    edot: Tensor
    time: Tensor
    cost: Tensor


class Outlook(NamedTuple):
    """What is known and wanted of an arm now, and stays so over the horizon.

    x_d, xdot_d: (..., 3) target, m, m/s. z: (..., 3) integral beside its error, m. off: (..., 3) m, of the measured tip
    from the model's. apart: (..., n) rad and m, of the controller's q from that of the arm's sections, which may be of
    other lengths. B_hat: (..., n, n_a) with which q_d is mapped to the tendons. payload: (...) kg. d: (..., n_f)
    generalized force that nothing else explains, N m and N.
    """

    x_d: Tensor
    xdot_d: Tensor
    z: Tensor
    off: Tensor
    apart: Tensor
    B_hat: Tensor
    payload: Tensor
    d: Tensor


class PredictedLoop(Part):
    """A step of the arm of `dynamics` under its tendons' loop, which Eq. (16) drives with a departure from it.

    The tip is asked for xdot_d + K e + v(t) and the configuration, as far as that leaves it free, for w(t) beside
    grad_Psi, with (v, w) on straight lines between knots. Without departure this is the controller's own loop. Between
    steps of the model rates are held.

    Args:
        backbone: The controller's model.
        inverse_kinematics: Its Eq. (16).
        dynamics: The arm, each of the model's sections divided into equal pieces, or into one.
        routing: Its tendons, as they act on it.
        *settings, **changes: See `PredictedLoopSettings`.
        obstacles: To be kept clear of, beside `spheres`.
        bend_bound, elongation_bound, reference_damping: Of the controller.
    """

    settings_type = PredictedLoopSettings
    horizon: float
    steps: int
    K_P: float
    K_D: float
    tendon_damping: float
    approach: float
    lead: float
    tip_error: float
    final_speed: float
    final_weight: float
    elongation: float | None
    tip_departure: float | None
    free_departure: float | None
    force: float | None
    force_limit: float | None
    length_limit: float | None
    excess: float
    intrusion: float
    clearance: float
    bend_bound: Setting | None
    elongation_bound: Setting | None
    B: Tensor
    lengths: Tensor

    def __init__(
        self,
        backbone: PCCBackbone,
        inverse_kinematics: InverseKinematics,
        dynamics: SoftArmDynamics,
        routing: TendonRouting,
        *settings: Any,
        obstacles: Sequence[Obstacle] = (),
        bend_bound: Setting | None = None,
        elongation_bound: Setting | None = None,
        reference_damping: float = 0.0,
        **changes: Any,
    ) -> None:
        super().__init__()
        s = resolved(PredictedLoopSettings, settings, changes)
        self.backbone = backbone
        self.inverse_kinematics = inverse_kinematics
        self.dynamics = dynamics
        self.reference_damping = reference_damping
        hold_numbers(self, bend_bound=bend_bound, elongation_bound=elongation_bound)
        listed = [(dynamics.lengths.new_tensor(each[:3]), float(each[3])) for each in s.spheres]
        bodies = [*obstacles, *(Sphere(*each) for each in listed)]
        self.near = ClearanceCost(bodies, s.radius, s.clearance, s.points) if bodies else None
        self.hold(s)
        self.arm = dynamics.kinematics()
        self.refine = dynamics.n_sections // backbone.n_sections
        lengths = dynamics.lengths.unflatten(-1, (-1, self.refine)).sum(-1)
        hold_rows(self, B=(self.arm.tendon_matrix(routing, dynamics.lengths), 2), lengths=(lengths, 1))

    @property
    def dt(self) -> float:
        """A step, s."""
        return self.horizon / self.steps

    def blank(self, knots: int) -> tuple[Predicted, Tensor, Outlook]:
        """Arguments of the form that one row has: what a compiler needs to see."""
        lengths = self.lengths
        q, q_d, zero = (lengths.new_zeros(size) for size in ((self.arm.n,), (self.backbone.n,), ()))
        point, departure = lengths.new_zeros(3), lengths.new_zeros(knots, 3 + self.backbone.n)
        now = Predicted(q, q, q_d, lengths.new_zeros(self.B.shape[-1]), point, point, zero, zero)
        B_hat = lengths.new_zeros(self.backbone.n, self.B.shape[-1])
        return now, departure, Outlook(point, point, point, point, q_d, B_hat, zero, q)

    def placed(self, q: Tensor) -> Placed:
        """The tip of an arm at q (..., n_f), and how it moves with it."""
        return self.arm.chain(q, self.dynamics.lengths.expand(*q.shape[:-1], -1))

    def sections(self, q: Tensor) -> Tensor:
        """The strains (..., n) of the sections of an arm at q (..., n_f), rad and m."""
        return q.unflatten(-1, (-1, self.refine, 3)).sum(-2).flatten(-2)

    def spread(self, q: Tensor) -> Tensor:
        """q (..., n_f) of sections' strains (..., n), of which each piece takes an equal part."""
        parts = (q.unflatten(-1, (-1, 1, 3)) / self.refine).expand(*q.shape[:-1], -1, self.refine, 3)
        return parts.flatten(-3)

    def departure(self, knots: Tensor, time: Tensor) -> Tensor:
        """(v, w) (..., 3 + n) of knots (..., k, 3 + n) at a time (...) s from now; beyond the horizon the last."""
        last = knots.shape[-2] - 1
        at = (time / self.horizon * last).clamp(0.0, last).unsqueeze(-1)
        hats = (1.0 - (at - torch.arange(last + 1, dtype=at.dtype, device=at.device)).abs()).clamp(min=0.0)
        return (hats.unsqueeze(-2) @ knots).squeeze(-2)

    def forward(self, now: Predicted, knots: Tensor, outlook: Outlook) -> Predicted:
        """The loop a step later, with the cost of where it is; from the horizon's end on, that of the end.

        Args:
            now: The loop.
            knots: (..., k, 3 + n) departure, m/s, rad/s and m/s.
            outlook: What is known and wanted.
        """
        dt = self.dt
        chain = self.placed(now.q)
        J_f = chain.tip_jacobian()
        # Tendons move all pieces of a section alike.
        J = J_f.unflatten(-1, (-1, self.refine, 3)).mean(-2).flatten(-2)
        e = outlook.x_d + now.time.unsqueeze(-1) * outlook.xdot_d - (chain.tip + outlook.off)
        y_now, ydot_now = self.tendons(now.q), self.tendons(now.qdot)
        cost = self._cost(now, knots, outlook, J_f, e, y_now)

        asked = self.departure(knots, now.time)
        wanted, beside = outlook.xdot_d + asked[..., :3], asked[..., 3:]
        q, step = self.sections(now.q) + outlook.apart, torch.full_like(now.time, dt)
        reference = ReferenceBounds.of(self.backbone.coordinates, self.bend_bound, self.elongation_bound)
        bounds = None if reference is None else reference.rates(now.q_d, step)
        rate = self.inverse_kinematics(J, e + outlook.z, wanted, q, step, bounds, beside)
        q_d = now.q_d + dt * rate
        if reference is not None:
            q_d = reference.held(q_d)
        damped = q_d - self.reference_damping * self.sections(now.qdot)
        y = (outlook.B_hat.mT @ damped.unsqueeze(-1)).squeeze(-1)
        u = self.K_P * (y - y_now) + self.K_D * ((y - now.y) / dt - ydot_now)
        tau = outlook.d + (self.B @ (u - self.tendon_damping * ydot_now).unsqueeze(-1)).squeeze(-1)
        square = self.B @ self.B.mT
        actuation = Actuation(tau, self.K_P * square, (self.K_D + self.tendon_damping) * square)
        arm = semi_implicit_step(self.dynamics, ArmState(now.q, now.qdot), actuation, dt, outlook.payload)
        # Rates first, so that a step as long as `lead` is stable.
        edot = (now.edot - (dt / self.lead) * self.approach * now.e) / (1.0 + dt / self.lead)
        return Predicted(arm.q, arm.qdot, q_d, y, now.e + dt * edot, edot, now.time + dt, now.cost + cost)

    def tendons(self, v: Tensor) -> Tensor:
        """B^T v: tendon length changes (..., n_a) m of a configuration, or their rates of a velocity."""
        return (self.B.mT @ v.unsqueeze(-1)).squeeze(-1)

    def _cost(self, now: Predicted, knots: Tensor, outlook: Outlook, J: Tensor, e: Tensor, y: Tensor) -> Tensor:
        """What the loop costs here (...)."""
        ends = now.time > self.horizon - 0.5 * self.dt
        tip = ((e - now.e) / self.tip_error).square().sum(-1)
        off = (J @ now.qdot.unsqueeze(-1)).squeeze(-1) - outlook.xdot_d + now.edot
        last = self.final_weight * (tip + (off / self.final_speed).square().sum(-1))
        way = tip
        if self.elongation is not None:
            way = way + (
                self.sections(now.q)[..., self.backbone.coordinates.elongations] / self.elongation
            ).square().sum(-1)
        asked = self.departure(knots, now.time)
        if self.tip_departure is not None:
            way = way + (asked[..., :3] / self.tip_departure).square().sum(-1)
        if self.free_departure is not None:
            way = way + (asked[..., 3:] / self.free_departure).square().sum(-1)
        u = self.K_P * (now.y - y)
        if self.force is not None:
            way = way + (u / self.force).square().mean(-1)
        if self.force_limit is not None:
            way = way + ((u.abs() / self.force_limit - 1.0).clamp(min=0.0) / self.excess).square().sum(-1)
        if self.length_limit is not None:
            way = way + ((now.y.abs() / self.length_limit - 1.0).clamp(min=0.0) / self.excess).square().sum(-1)
        if self.near is not None:
            # The hinge of a clearance cost is over its activation distance, and halved.
            scale = 2.0 * (self.clearance / self.intrusion) ** 2
            way = way + scale * self.near(self.arm, now.q, self.dynamics.lengths)[0]
        return torch.where(ends, last, way / self.steps)
