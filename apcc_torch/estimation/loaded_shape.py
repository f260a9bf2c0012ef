"""The arm's shape from poses, tendon lengths and mechanics: what lies between the sensors is what the load makes of it.

The arm is divided finer than the model. Tendons bend and stretch a section evenly; gravity and the load at the tip do
not. With S spreading a section's strains over its pieces, P = I - S S^+ and K, G of the finer arm, its configuration is

    q_f = S c - P K^-1 (G_0(q_f) + m G_1(q_f)),

c (..., n) the strains of the sections and m the load at the tip, kg: at rest P (K q_f + G) = 0, for tendons pull on
all pieces of a section alike. (c, m) is the maximum a posteriori of sensor poses, tendon lengths y = B_f^T q_f, a wide
prior on c, and a load that changes slowly. Before anything is measured, c is that of the arm as it was built, under
tensions of which nothing is known: with F = S^T K^-1 B_f, bends scatter as F F^T does. A tendon bends every section
that it passes, so sections between which no sensor sits bend alike.
"""

from __future__ import annotations

from typing import Any, NamedTuple, Self

import torch
from torch import Tensor

from apcc_torch.errors import ConfigError
from apcc_torch.estimation.loaded_shape_settings import LoadedShapeSettings
from apcc_torch.estimation.tension_prior import tension_information
from apcc_torch.lie import so3
from apcc_torch.linalg import scaled_within, solve_spd
from apcc_torch.model.abscissae import located
from apcc_torch.model.arm import Arm
from apcc_torch.model.arm_rest import strain_at_rest
from apcc_torch.model.dynamics import SoftArmDynamics
from apcc_torch.model.kinematic_model import Placed
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


class ShapeState(NamedTuple):
    """What is known of the arm's shape.

    sections: (..., n) their bends, rad, and lengths, m: c of the module's head, and with it the rest lengths.
    load: (...) m at the tip, kg. variance: (...) of it, over that of before it is felt.
    sag: (..., 2, n_f) of the pieces' strains, by the arm's own weight and by each kg at the tip.
    misfit: (...) how far the sensor that is farthest off was from the shape that the last step began with, over the
        standard deviation, squared.
    """

    sections: Tensor
    load: Tensor
    variance: Tensor
    sag: Tensor
    misfit: Tensor


class LoadedShape(Part):
    """Estimates an arm's shape under an unknown load; see the module's head.

    One Gauss-Newton step a sample: the state is the seed of the next. Directions that neither sensors nor tendons tell
    stay with the prior, so fewer sensors than sections are an ordinary case.

    Args:
        dynamics: The arm as it is believed to be, each section divided into `refine` equal pieces.
        routing: Its tendons.
        abscissae: (..., k) of the sensors, m.
        *settings, **changes: See `LoadedShapeSettings`.
        rest: (..., n) strains of the sections before anything is measured, rad and m; None for those of a straight arm.

    Raises:
        ConfigError: The number of the arm's pieces is no multiple of `refine`.
        ValueRangeError: A setting is out of range.

    Example:
        >>> arm = Arm(lengths=[0.2, 0.25], mass=0.4)
        >>> shape = LoadedShape.on(arm, LoadedShapeSettings())
        >>> state = shape.initial_state(torch.tensor([0.0, 0.0, 0.2, 0.0, 0.0, 0.25]).double())
        >>> shape.configuration(state).shape, float(state.load)
        (torch.Size([12]), 0.0)
    """

    settings_type = LoadedShapeSettings
    abscissae: Tensor
    B: Tensor
    rest: Tensor
    information: Tensor
    position_noise: Setting
    angular_noise: Setting
    tendon_noise: Setting
    bend: Setting
    elongation: Setting
    load: Setting
    load_rate: Setting
    sag_time: Setting
    refine: int

    def __init__(
        self,
        dynamics: SoftArmDynamics,
        routing: TendonRouting,
        abscissae: Tensor,
        *settings: Any,
        rest: Tensor | None = None,
        **changes: Any,
    ) -> None:
        super().__init__()
        s = resolved(LoadedShapeSettings, settings, changes)
        if dynamics.n_sections % s.refine:
            raise ConfigError(f"dynamics must have {s.refine} pieces a section, got {dynamics.n_sections} pieces")
        self.dynamics = dynamics
        self.backbone = dynamics.kinematics()
        self.n_sections = dynamics.n_sections // s.refine
        B = routing.matrix(dynamics.lengths)
        if rest is None:
            rest = torch.zeros_like(B[..., : 3 * self.n_sections, 0])
        check_tensor("rest", rest, (3 * self.n_sections,))
        information = tension_information(B, dynamics.stiffness_diagonal.to(B), s.refine)
        hold_rows(self, abscissae=(abscissae, 1), B=(B, 2), rest=(rest, 1), information=(information, 2))
        self.hold(s)

    @classmethod
    def on(cls, arm: Arm, settings: LoadedShapeSettings) -> Self:
        """The estimator of an arm as it is believed to be."""
        rest = strain_at_rest(arm)
        return cls(arm.dynamics(settings.refine), arm.routing(), arm.sensor_places(), settings, rest=rest)

    def initial_state(self, sections: Tensor) -> ShapeState:
        """Sections of which nothing more is known yet.

        Args:
            sections: (..., n) their bends, rad, and lengths, m, in the order of a `PCCBackbone`'s q.
        """
        load, none = torch.zeros_like(sections[..., 0]), torch.zeros_like(self._spread(sections))
        return ShapeState(
            sections, load, torch.ones_like(load), torch.stack((none, none), dim=-2), torch.zeros_like(load)
        )

    def strain(self, state: ShapeState) -> Tensor:
        """c (..., n): bends, rad, and elongations, m, of the sections."""
        length = self._lengths(state.sections)
        none = torch.zeros_like(length)
        return state.sections - torch.stack((none, none, length), dim=-1).flatten(-2)

    def configuration(self, state: ShapeState) -> Tensor:
        """q_f (..., n_f) of the arm's pieces: rad, rad, m. None is shorter than a share of its rest length."""
        q = self._spread(self.strain(state)) + self._sag(state)
        return self._longer_than(q, (SHORTEST - 1.0) * self.pieces(q))

    def _longer_than(self, q: Tensor, least: Tensor) -> Tensor:
        return torch.maximum(q, self.backbone.coordinates.with_elongations(torch.full_like(q, -torch.inf), least))

    def change(self, before: ShapeState, after: ShapeState) -> Tensor:
        """(..., n_f) by how much the arm's pieces have moved, rad and m."""
        return self.configuration(after) - self.configuration(before)

    def forward(
        self, state: ShapeState, T: Tensor, usable: Tensor, oriented: Tensor, y: Tensor | None, dt: Tensor
    ) -> ShapeState:
        """One step; unchecked, of one leading shape.

        Args:
            state: From `initial_state` or the last step.
            T: (..., k, 4, 4) sensor poses, finite where they count.
            usable, oriented: (..., k) bool, positions and orientations that count.
            y: (..., n_a) tendon length changes, m, not finite where unknown; None where none is known.
            dt: (...) s since the last step.
        """
        sag = self._renewed(state, dt)
        H, slope, prior, misfit = self._weighed(state._replace(sag=sag), T, usable, oriented, y, dt)
        last = torch.cat((torch.zeros_like(slope[..., :-1]), torch.ones_like(slope[..., -1:])), dim=-1)
        solved = solve_spd(H, torch.stack((slope, last), dim=-1))
        step = solved[..., 0]
        step = scaled_within(step, LARGEST_STEP, of=step[..., :-1])
        moved = ShapeState(
            self._longer_than(state.sections + step[..., :-1], SHORTEST * self._lengths(state.sections)),
            (state.load + step[..., -1]).clamp(min=0.0),
            solved[..., -1, 1] / prior,
            sag,
            misfit,
        )
        finite = torch.isfinite(step).all(-1)
        return ShapeState(
            *(
                torch.where(finite[(..., *(None,) * (new.dim() - finite.dim()))], new, old)
                for new, old in zip(moved, state, strict=True)
            )
        )

    def covariance(
        self, state: ShapeState, T: Tensor, usable: Tensor, oriented: Tensor, y: Tensor | None, dt: Tensor
    ) -> Tensor:
        """Covariance (..., n + 1, n + 1) of the strains and the load that a step with these arguments finds.

        It is that of the measurements' noise and the priors as they are set: rad, m and kg.
        """
        H = self._weighed(state._replace(sag=self._renewed(state, dt)), T, usable, oriented, y, dt)[0]
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

    def _weighed(
        self, state: ShapeState, T: Tensor, usable: Tensor, oriented: Tensor, y: Tensor | None, dt: Tensor
    ) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """Information (..., n + 1, n + 1), it times their change, the load's first variance, and the `misfit`."""
        r, J = self._residual(state, T, usable, oriented, y)
        prior = (aligned(self.load, 0) * self._mass(r)).square()
        walked = (state.variance + (aligned(self.load_rate, 0) / aligned(self.load, 0)) ** 2 * dt).clamp(max=1.0)
        strain = self.strain(state)
        deviation = self._deviation(strain)
        known = self.information.to(r) / (deviation.unsqueeze(-1) * deviation.unsqueeze(-2))
        away = (known @ (strain - self.rest.to(r)).unsqueeze(-1)).squeeze(-1)
        slope = (J.mT @ r.unsqueeze(-1)).squeeze(-1) - torch.nn.functional.pad(away, (0, 1))
        H = J.mT @ J + torch.nn.functional.pad(known, (0, 1, 0, 1))
        load = torch.nn.functional.pad((walked * prior).reciprocal().unsqueeze(-1), (slope.shape[-1] - 1, 0))
        misfit = r[..., : 6 * T.shape[-3]].unflatten(-1, (-1, 3)).square().sum(-1).amax(-1)
        return H + torch.diag_embed(load), slope, prior, misfit

    def _moved(self, body: Tensor, state: ShapeState) -> Tensor:
        """A body Jacobian (..., k, 6, n_f) by the strains and the load (..., k, 6, n + 1)."""
        return torch.cat((self._gathered(body), body @ state.sag[..., None, 1, :, None]), dim=-1)

    def _spread(self, strain: Tensor) -> Tensor:
        """S c: each piece takes an equal part of its section's strain (..., n_f)."""
        return (
            (strain.unflatten(-1, (-1, 1, 3)) / self.refine).expand(*strain.shape[:-1], -1, self.refine, 3).flatten(-3)
        )

    def _gathered(self, J: Tensor) -> Tensor:
        """J S (..., n) of J (..., n_f)."""
        return J.unflatten(-1, (-1, self.refine, 3)).mean(-2).flatten(-2)

    def _lengths(self, like: Tensor) -> Tensor:
        """(..., n_b) rest lengths of the sections, m."""
        return self.dynamics.lengths.to(like).unflatten(-1, (-1, self.refine)).sum(-1)

    def _mass(self, like: Tensor) -> Tensor:
        return self.dynamics.masses.to(like).sum(-1)

    def _deviation(self, strain: Tensor) -> Tensor:
        """(..., n) of a section's strain before it is measured."""
        length = self._lengths(strain)
        bend, elongation = torch.broadcast_tensors(
            torch.ones_like(length) * aligned(self.bend, 1), aligned(self.elongation, 1) * length
        )
        return torch.stack((bend, bend, elongation), dim=-1).flatten(-2).expand_as(strain)

    def _sag(self, state: ShapeState) -> Tensor:
        own, each = state.sag.unbind(-2)
        return own + state.load.unsqueeze(-1) * each

    def _renewed(self, state: ShapeState, dt: Tensor) -> Tensor:
        """The sag (..., 2, n_f) after a step: a share of the way to -P K^-1 G at the last shape."""
        q, none = self.configuration(state), torch.zeros_like(state.load)
        weight = self.dynamics.static_load(q, none)
        each = self.dynamics.static_load(q, none + 1.0) - weight
        strain = -torch.stack((weight, each), dim=-2) / self.dynamics.stiffness_diagonal.to(q).unsqueeze(-2)
        pieces = strain.unflatten(-1, (-1, self.refine, 3))
        own = (pieces - pieces.mean(-2, keepdim=True)).flatten(-3)  # P
        share = (1.0 - torch.exp(-dt / aligned(self.sag_time, 0))).clamp(max=LARGEST_SHARE)
        return state.sag + share[..., None, None] * (own - state.sag)

    def _residual(
        self, state: ShapeState, T: Tensor, usable: Tensor, oriented: Tensor, y: Tensor | None
    ) -> tuple[Tensor, Tensor]:
        """What the measurements leave (..., m), over its standard deviation, and its derivative (..., m, n + 1)."""
        q = self.configuration(state)
        chain = self.chain_at(q, self.abscissae)
        into_body = chain.rotation.mT
        offset = torch.where(usable.unsqueeze(-1), T[..., :3, 3] - chain.tip, 0.0)
        turn = into_body @ torch.where(oriented[..., None, None], T[..., :3, :3], chain.rotation)
        linear, angular = (into_body @ offset.unsqueeze(-1)).squeeze(-1), so3.log(turn)
        body = self._moved(chain.body_jacobian(), state)
        weights = torch.broadcast_tensors(
            oriented.to(q) / aligned(self.angular_noise, 1), usable.to(q) / aligned(self.position_noise, 1)
        )
        weight = torch.stack(weights, dim=-1).unsqueeze(-1).expand(*usable.shape, 2, 3).flatten(-2)
        r = (torch.cat((angular, linear), dim=-1) * weight).flatten(-2)
        J = (body * weight.unsqueeze(-1)).flatten(-3, -2)
        if y is None:
            return r, J
        B = self.B.to(q)
        off = y - (B.mT @ q.unsqueeze(-1)).squeeze(-1)
        known = torch.isfinite(off)
        scale = known.to(q) / aligned(self.tendon_noise, 1)
        each = B.mT @ state.sag[..., 1, :, None]
        row = torch.cat((self._gathered(B.mT).expand(*each.shape[:-1], -1), each), dim=-1)
        return (
            torch.cat((r, torch.where(known, off, 0.0) * scale), dim=-1),
            torch.cat((J, row * scale.unsqueeze(-1)), dim=-2),
        )

    def pieces(self, q: Tensor) -> Tensor:
        """(..., n_p) rest lengths of the arm's pieces, m, of the leading shape of q."""
        lengths = self.dynamics.lengths.to(q)
        return lengths.expand(*q.shape[:-1], lengths.shape[-1])

    def chain_at(self, q: Tensor, X: Tensor) -> Placed:
        """The arm at q (..., n_f) up to abscissae X (..., k) on the arm at rest, m."""
        return self.backbone.chain_to(q, self.backbone.material_points(self.pieces(q), *self._located(q, X)))

    def sensors_at(self, q: Tensor) -> tuple[Tensor, Tensor]:
        """Normalised abscissa and piece (..., k) of the sensors, of the leading shape of q."""
        return self._located(q, self.abscissae)

    def _located(self, q: Tensor, X: Tensor) -> tuple[Tensor, Tensor]:
        return located(X.to(q).expand(*q.shape[:-1], X.shape[-1]), self.pieces(q))

    def share(self, q: Tensor, X_tilde: Tensor, piece: Tensor) -> Tensor:
        """How far along the arm material points (..., k) of its pieces lie, over its length, at q (..., n_f)."""
        lengths = self.backbone.section_lengths(q, self.pieces(q))
        ends = lengths.cumsum(-1)
        along = torch.gather(ends - lengths, -1, piece) + X_tilde * torch.gather(lengths, -1, piece)
        return along / ends[..., -1:]
