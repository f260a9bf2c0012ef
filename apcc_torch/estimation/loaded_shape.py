"""The arm's shape from its sensors, tendon lengths and mechanics: what lies between them is what the load makes of it.

The arm is divided finer than the model. Tendons bend and stretch a section evenly; gravity and the load at the tip do
not. With S spreading a section's strains over its pieces, A adding them up, P = I - S A and K, G of the finer arm,

    q_f = S c - P K^-1 (G_0(q_f) + m G_1(q_f))

is its configuration, c (..., n) the strains of the sections and m the load at the tip, kg: at rest P (K q_f + G) = 0,
for tendons pull on all pieces of a section alike; where they end within one, S has `uneven_tension` too. (c, m) is the
maximum a posteriori of what is measured, poses or parts of them, curvature and tendon lengths y = B_f^T q_f, of a wide
prior on c, and of a load that changes slowly. Before anything is measured, c is that of the arm as it was built, under
tensions of which nothing is known: with F = A K^-1 B_f, bends scatter as F D^2 F^T does, D how far tensions do.
"""

from __future__ import annotations

from typing import Any, Self

import torch
from torch import Tensor

from apcc_torch.errors import ConfigError
from apcc_torch.estimation.curvature_rows import curvature_rows
from apcc_torch.estimation.finer_arm import FinerArm
from apcc_torch.estimation.inertial_rows import inertial_rows
from apcc_torch.estimation.loaded_shape_settings import LoadedShapeSettings
from apcc_torch.estimation.pose_rows import pose_rows, tendon_rows, tendon_weights
from apcc_torch.estimation.shape_state import ShapeMeasurement, ShapeState
from apcc_torch.estimation.tension_prior import tension_information, tension_scatter, untold
from apcc_torch.estimation.uneven_tension import uneven_tension
from apcc_torch.linalg import scaled_within, solve_spd
from apcc_torch.model.arm import Arm
from apcc_torch.model.arm_rest import strain_at_rest
from apcc_torch.model.curvature import curvature_places, curvature_weights
from apcc_torch.model.dynamics import SoftArmDynamics
from apcc_torch.model.sensor_kinds import SensorKinds
from apcc_torch.model.tendons import TendonRouting
from apcc_torch.part import Part, hold_rows
from apcc_torch.settings import Setting, aligned, resolved
from apcc_torch.shapes import check_tensor

LARGEST_SHARE = 0.3
"""How much of the sag is renewed in one step at most: where gravity is strong beside the arm's stiffness, more would
overshoot, and the next step too."""
LARGEST_STEP = 0.3
"""Largest change of a section's strain in one step, rad and m."""
SHORTEST = 0.05
"""Of its rest length, the least that a section, or a piece of one, keeps."""


class LoadedShape(FinerArm, Part):
    """Estimates an arm's shape under an unknown load; see the module's head.

    One Gauss-Newton step a sample: the state is the seed of the next. Directions that neither sensors nor tendons tell
    stay with the prior, so fewer sensors than sections are an ordinary case.

    Args:
        dynamics: The arm as it is believed to be, each section divided into `refine` equal pieces.
        routing: Its tendons.
        abscissae: (..., k) of the sensors, m.
        *settings, **changes: See `LoadedShapeSettings`.
        rest: (..., n) strains of the sections before anything is measured, rad and m; None for those of a straight arm.
        tensions: (..., n_a) how its tendons' tensions scatter before anything is measured; None where all are alike.
        tendon_covariance: (..., n_a, n_a) of what tendons' length changes are off by, m^2; None: `tendon_noise` each.
        kinds: What the sensors measure; None for poses.
        curvature_places: (..., n_c) abscissae where curvature is measured, m; None for nowhere.

    Raises:
        ConfigError: The number of the arm's pieces is no multiple of `refine`.
        ValueRangeError: A setting is out of range, or tendon_covariance is not positive definite.

    Example:
        >>> arm = Arm(lengths=[0.2, 0.25], mass=0.4)
        >>> shape = LoadedShape.on(arm, LoadedShapeSettings())
        >>> state = shape.initial_state(torch.tensor([0.0, 0.0, 0.2, 0.0, 0.0, 0.25]).double())
        >>> shape.configuration(state).shape, float(state.load)
        (torch.Size([12]), 0.0)
    """

    settings_type = LoadedShapeSettings
    B: Tensor
    rest: Tensor
    information: Tensor
    curvature_weights: Tensor | None
    tendon_weights: Tensor | None
    position_noise: Setting
    angular_noise: Setting
    tendon_noise: Setting
    tilt_noise: Setting
    heading_noise: Setting
    heading_drift: Setting
    curvature_noise: Setting
    bend: Setting
    elongation: Setting
    load: Setting
    load_rate: Setting
    sag_time: Setting

    def __init__(
        self,
        dynamics: SoftArmDynamics,
        routing: TendonRouting,
        abscissae: Tensor,
        *settings: Any,
        rest: Tensor | None = None,
        tensions: Tensor | None = None,
        tendon_covariance: Tensor | None = None,
        kinds: SensorKinds | None = None,
        curvature_places: Tensor | None = None,
        **changes: Any,
    ) -> None:
        super().__init__()
        s = resolved(LoadedShapeSettings, settings, changes)
        if dynamics.n_sections % s.refine:
            raise ConfigError(f"dynamics must have {s.refine} pieces a section, got {dynamics.n_sections} pieces")
        self.dynamics, self.backbone = dynamics, dynamics.kinematics()
        self.n_sections = dynamics.n_sections // s.refine
        B = routing.matrix(dynamics.lengths)
        rest = torch.zeros_like(B[..., : 3 * self.n_sections, 0]) if rest is None else rest
        check_tensor("rest", rest, (3 * self.n_sections,))
        K, lengths = dynamics.stiffness_diagonal.to(B), dynamics.lengths.to(B)
        information = tension_information(B, K, s.refine, lengths, tensions)
        self.kinds = kinds
        at = None if curvature_places is None else curvature_places.to(dynamics.lengths)
        weights = None if at is None else curvature_weights(dynamics.lengths, s.refine, at)
        hold_rows(self, abscissae=(abscissae, 1), B=(B, 2), rest=(rest, 1), information=(information, 2))
        told = None if tendon_covariance is None else tendon_weights(tendon_covariance, B.shape[-1])
        hold_rows(self, curvature_weights=(weights, 2), tendon_weights=(told, 3))
        hold_rows(self, uneven=(uneven_tension(B, K, s.refine, lengths), 2))
        self.hold(s)

    @classmethod
    def on(cls, arm: Arm, settings: LoadedShapeSettings, tendon_covariance: Tensor | None = None) -> Self:
        """The estimator of an arm as it is believed to be."""
        return cls(
            arm.dynamics(settings.refine),
            arm.routing(),
            arm.sensor_places(),
            settings,
            rest=strain_at_rest(arm),
            tensions=tension_scatter(arm),
            tendon_covariance=tendon_covariance,
            kinds=arm.sensor_kinds(),
            curvature_places=curvature_places(arm),
        )

    @property
    def n_curvature(self) -> int | None:
        """Places where curvature is measured; None where it is not."""
        return None if self.curvature_weights is None else self.curvature_weights.shape[-2]

    def initial_state(self, sections: Tensor) -> ShapeState:
        """Sections of which nothing more is known yet.

        Args:
            sections: (..., n) their bends, rad, and lengths, m, in the order of a `PCCBackbone`'s q.
        """
        still, none = torch.zeros_like(sections[..., 0]), torch.zeros_like(self._spread(sections))
        unknown = torch.full_like(torch.cat((sections, still.unsqueeze(-1)), dim=-1), torch.inf)
        return ShapeState(sections, still, unknown, torch.stack((none, none), dim=-2), still, still)

    def strain(self, state: ShapeState) -> Tensor:
        """c (..., n): bends, rad, and elongations, m, of the sections."""
        length = self._lengths(state.sections)
        none = torch.zeros_like(length)
        return state.sections - torch.stack((none, none, length), dim=-1).flatten(-2)

    def configuration(self, state: ShapeState) -> Tensor:
        """q_f (..., n_f) of the arm's pieces: rad, rad, m. None is shorter than a share of its rest length."""
        own, each = state.sag.unbind(-2)
        q = self._spread(self.strain(state), self.rest) + own + state.load.unsqueeze(-1) * each
        return self._longer_than(q, (SHORTEST - 1.0) * self.pieces(q))

    def _longer_than(self, q: Tensor, least: Tensor) -> Tensor:
        return torch.maximum(q, self.backbone.coordinates.with_elongations(torch.full_like(q, -torch.inf), least))

    def change(self, before: ShapeState, after: ShapeState) -> Tensor:
        """(..., n_f) by how much the arm's pieces have moved, rad and m."""
        return self.configuration(after) - self.configuration(before)

    def forward(
        self,
        state: ShapeState,
        T: Tensor,
        usable: Tensor,
        oriented: Tensor,
        y: Tensor | None,
        dt: Tensor,
        curvature: Tensor | None = None,
    ) -> ShapeState:
        """One step; unchecked, of one leading shape.

        Args:
            state: From `initial_state` or the last step.
            T: (..., k, 4, 4) sensor poses, finite where they count.
            usable, oriented: (..., k) bool, positions and orientations that count.
            y: (..., n_a) tendon length changes, m, not finite where unknown; None where none is known.
            dt: (...) s since the last step.
            curvature: (..., n_c, 2) measured, 1/m, not finite where unknown; None where none is known.
        """
        now = self._begun(state, dt)
        H, slope, misfit = self._weighed(now, ShapeMeasurement(T, usable, oriented, y, curvature), dt)
        eye = torch.eye(H.shape[-1], dtype=H.dtype, device=H.device).expand_as(H)
        step, P = solve_spd(H, torch.cat((slope.unsqueeze(-1), eye), dim=-1)).tensor_split((1,), dim=-1)
        step = step.squeeze(-1)
        step = scaled_within(step, LARGEST_STEP, of=step[..., :-1])
        moved = ShapeState(
            self._longer_than(state.sections + step[..., :-1], SHORTEST * self._lengths(state.sections)),
            (state.load + step[..., -1]).clamp(min=0.0),
            P.diagonal(dim1=-2, dim2=-1).sqrt(),
            now.sag,
            misfit,
            now.age,
        )
        return moved.where(torch.isfinite(step).all(-1), state)

    def untold(self, state: ShapeState) -> Tensor:
        """(...) bool, rows in which a strain of a section is still the prior's; see `tension_prior.untold`."""
        deviation = state.deviation[..., :-1]
        return untold(deviation / self._deviation(deviation), self.information.to(deviation))

    def covariance(
        self,
        state: ShapeState,
        T: Tensor,
        usable: Tensor,
        oriented: Tensor,
        y: Tensor | None,
        dt: Tensor,
        curvature: Tensor | None = None,
    ) -> Tensor:
        """Covariance (..., n + 1, n + 1) of the strains and the load that a step with these arguments finds.

        It is that of the measurements' noise and the priors as they are set: rad, m and kg.
        """
        H = self._weighed(self._begun(state, dt), ShapeMeasurement(T, usable, oriented, y, curvature), dt)[0]
        return solve_spd(H, torch.eye(H.shape[-1], dtype=H.dtype, device=H.device).expand_as(H))

    def point_covariance(self, state: ShapeState, covariance: Tensor, X: Tensor) -> Tensor:
        """Covariance (..., k, 3, 3) of points of the arm, m^2, in the base's axes.

        Args:
            state: From a step.
            covariance: (..., n + 1, n + 1) of its strains and load.
            X: (..., k) abscissae of the points on the arm at rest, m.
        """
        q = self.configuration(state)
        chain = self.chain_at(q, X)
        move = chain.rotation @ self._moved(chain.body_jacobian(), state)[..., 3:, :]
        return move @ covariance.unsqueeze(-3) @ move.mT

    def _weighed(self, state: ShapeState, seen: ShapeMeasurement, dt: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Information (..., n + 1, n + 1), it times their change, and the `misfit`."""
        r, J = self.residual(state, seen)
        prior = (aligned(self.load, 0) * self._mass(r)).square()
        walk = (aligned(self.load_rate, 0) * self._mass(r)).square() * dt
        variance = torch.minimum(state.deviation[..., -1].square() + walk, prior)
        known, off = self.believed(state)
        away = (known @ off.unsqueeze(-1)).squeeze(-1)
        slope = (J.mT @ r.unsqueeze(-1)).squeeze(-1) - torch.nn.functional.pad(away, (0, 1))
        H = J.mT @ J + torch.nn.functional.pad(known, (0, 1, 0, 1))
        load = torch.nn.functional.pad(variance.reciprocal().unsqueeze(-1), (slope.shape[-1] - 1, 0))
        told = 6 * seen.T.shape[-3] + (0 if self.kinds is None else 3 * len(self.kinds.inertial))
        misfit = r[..., :told].unflatten(-1, (-1, 3)).square().sum(-1).amax(-1)
        return H + torch.diag_embed(load), slope, misfit

    def believed(self, state: ShapeState) -> tuple[Tensor, Tensor]:
        """Information (..., n, n) of the strains before they are measured, and by how much they differ (..., n)."""
        strain = self.strain(state)
        deviation = self._deviation(strain)
        known = self.information.to(strain) / (deviation.unsqueeze(-1) * deviation.unsqueeze(-2))
        return known, strain - self.rest.to(strain)

    def _moved(self, body: Tensor, state: ShapeState) -> Tensor:
        """A Jacobian (..., k, r, n_f) by the strains and the load (..., k, r, n + 1)."""
        return torch.cat((self._gathered(body), body @ state.sag[..., None, 1, :, None]), dim=-1)

    def _begun(self, state: ShapeState, dt: Tensor) -> ShapeState:
        """The state as a step begins with it: its sag renewed, and older by dt (...), s."""
        return state._replace(sag=self.renewed(state, dt), age=state.age + dt)

    def _deviation(self, strain: Tensor) -> Tensor:
        """(..., n) of a section's strain before it is measured."""
        length = self._lengths(strain)
        bend, elongation = torch.broadcast_tensors(
            torch.ones_like(length) * aligned(self.bend, 1), aligned(self.elongation, 1) * length
        )
        return torch.stack((bend, bend, elongation), dim=-1).flatten(-2).expand_as(strain)

    def renewed(self, state: ShapeState, dt: Tensor) -> Tensor:
        """The sag (..., 2, n_f) after a step: a share of the way to -P K^-1 G at the last shape."""
        q, none = self.configuration(state), torch.zeros_like(state.load)
        weight = self.dynamics.static_load(q, none)
        each = self.dynamics.static_load(q, none + 1.0) - weight
        strain = -torch.stack((weight, each), dim=-2) / self.dynamics.stiffness_diagonal.to(q).unsqueeze(-2)
        own = strain - torch.stack([self._spread(self._added(each)) for each in strain.unbind(-2)], dim=-2)  # P
        share = (1.0 - torch.exp(-dt / aligned(self.sag_time, 0))).clamp(max=LARGEST_SHARE)
        return state.sag + share[..., None, None] * (own - state.sag)

    def residual(self, state: ShapeState, seen: ShapeMeasurement) -> tuple[Tensor, Tensor]:
        """What measurements leave of a shape (..., m), over its deviation, and the shape's own slope (..., m, n + 1).

        By its strains and the load. Tendons are the last n_a rows, but for curvature.
        """
        T, usable, oriented, y, curvature = seen
        q = self.configuration(state)
        chain, units = self.chain_at(q, self.abscissae), () if self.kinds is None else self.kinds.inertial
        body, firm = self._moved(chain.body_jacobian(), state), oriented
        if self.kinds is not None and units:
            firm = oriented & ~self.kinds.drifting.to(oriented.device)
        rows = [pose_rows(chain, body, T, usable, firm, self.position_noise, self.angular_noise)]
        if self.kinds is not None and units:
            drift = aligned(self.heading_noise, 0) ** 2 + aligned(self.heading_drift, 0) ** 2 * state.age
            R, counts, headed = chain.rotation[..., units, :, :], oriented[..., units], self.kinds.headed.to(q)
            measured = torch.where(counts[..., None, None], T[..., units, :3, :3], R)
            r, W = inertial_rows(R, measured, counts, headed, self.tilt_noise, drift)
            rows.append((r.flatten(-2), (W @ body[..., units, :3, :]).flatten(-3, -2)))
        if y is not None:
            weights = None if self.tendon_weights is None else self.tendon_weights.to(q)
            r, J = tendon_rows(q, self.B.to(q), y, self.tendon_noise, weights)
            rows.append((r, self._moved(J.unsqueeze(-3), state).squeeze(-3)))
        if curvature is not None and self.curvature_weights is not None:
            weights = self.curvature_weights.to(q)
            r, J = curvature_rows(q, self.pieces(q), weights, curvature, self.curvature_noise)
            rows.append((r, self._moved(J.unsqueeze(-3), state).squeeze(-3)))
        return torch.cat([r for r, _ in rows], dim=-1), torch.cat([J for _, J in rows], dim=-2)
