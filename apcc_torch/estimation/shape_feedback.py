"""State feedback through the arm's shape: estimated with mechanics, and followed by the model."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple, Self

import torch
from torch import Tensor

from apcc_torch.estimation.arc_fit import ArcFit, ArcFitSettings
from apcc_torch.estimation.counted import counted
from apcc_torch.estimation.feedback import Inference
from apcc_torch.estimation.fit import Problem
from apcc_torch.estimation.loaded_shape import LoadedShape
from apcc_torch.estimation.loaded_shape_settings import LoadedShapeSettings
from apcc_torch.estimation.shape_state import ShapeState
from apcc_torch.estimation.state_feedback import StateFeedback
from apcc_torch.lie import se3
from apcc_torch.model.abscissae import MaterialPoints, located
from apcc_torch.model.arm import Arm
from apcc_torch.model.kinematic_model import KinematicModel
from apcc_torch.part import Part
from apcc_torch.settings import aligned
from apcc_torch.shapes import check_tensor

SAMPLES = 2
"""Points on each piece of the arm that the model is fitted to."""
MISFIT = 10.0
"""Standard deviations that a sensor is off from a shape at rest which is another branch's, or another arm's."""


class FollowedShape(NamedTuple):
    """What is known of the shape, and what the model made of it.

    shape: Of the arm. lengths: (..., n_b) of the model's sections as they were, rest length and elongation, m.
    tip: (..., 3) x_late of `ShapeFeedback.ahead`, m, infinite before the first step.
    """

    shape: ShapeState
    lengths: Tensor
    tip: Tensor


@dataclass(frozen=True, kw_only=True)
class ShapeFeedbackSettings(LoadedShapeSettings, ArcFitSettings):
    """Settings of `ShapeFeedback`: those of `LoadedShape` and of `ArcFit`."""


class _Seen(NamedTuple):
    """What is measured.

    problem: As algorithm 2 has it. T: (..., k, 4, 4) poses, m. oriented: (..., k) bool, whose orientations count.
    curvature: (..., n_c, 2) 1/m. told: (...) bool, rows that are told of by what algorithm 2 does not take; None where
    there is nothing of that.
    """

    problem: Problem
    T: Tensor
    oriented: Tensor
    curvature: Tensor | None
    told: Tensor | None


class ShapeFeedback(Part):
    """q_bar of the model that runs along the shape of a `LoadedShape`, in place of algorithm 2's.

    Algorithm 2 meets the sensors, whatever lies between them. Here the shape between them is known first, from
    mechanics, and the model follows all of it.

    A loaded arm is soft where its load pushes it on, and follows late: a loop on where its tip is swings. So the loop
    acts on where it will be, see `ahead`.

    Args:
        shape: Of the arm.
        fit: Of the model to it.

    Example:
        >>> arm = Arm(lengths=[0.2, 0.25], mass=0.4)
        >>> feedback = ShapeFeedback.on(arm, arm.backbone(), ShapeFeedbackSettings())
        >>> q, L0 = torch.zeros(6).double(), arm.rest_lengths()
        >>> T, all_of_them = arm.backbone().pose(q, L0, *decouple(L0.cumsum(0), L0)), torch.ones(2).bool()
        >>> dt, state = torch.tensor(0.01).double(), feedback.initial_state(q, L0)
        >>> state, q_bar = feedback(state, q, L0, T, all_of_them, all_of_them, None, dt)
        >>> q_bar.shape
        torch.Size([6])
    """

    def __init__(self, shape: LoadedShape, fit: ArcFit) -> None:
        super().__init__()
        self.shape = shape
        self.fit = fit

    @classmethod
    def on(cls, arm: Arm, backbone: KinematicModel, settings: ShapeFeedbackSettings) -> Self:
        """The feedback of an arm as it is believed to be, with a model of its sections."""
        return cls(LoadedShape.on(arm, settings), ArcFit(backbone, arm.rest_lengths().clone(), settings))

    def initial_state(self, q: Tensor, pi_hat: Tensor) -> FollowedShape:
        """A shape of which the model's configuration q (..., n) and rest lengths pi_hat (..., n_b) tell first."""
        backbone = self.fit.backbone
        bends, lengths = backbone.coordinates.bends(q), pi_hat + q[..., backbone.coordinates.elongations]
        sections = torch.cat((bends, lengths.unsqueeze(-1)), dim=-1).flatten(-2)
        return FollowedShape(self.shape.initial_state(sections), lengths, torch.full_like(sections[..., :3], torch.inf))

    def forward(
        self,
        state: FollowedShape,
        q_bar: Tensor,
        pi_hat: Tensor,
        T: Tensor,
        usable: Tensor,
        oriented: Tensor,
        y: Tensor | None,
        dt: Tensor,
        curvature: Tensor | None = None,
    ) -> tuple[FollowedShape, Tensor]:
        """One step; unchecked, of one leading shape.

        Args:
            state: From `initial_state` or the last step.
            q_bar: (..., n) the last one.
            pi_hat: (..., n_b) rest lengths now, m.
            T, usable, oriented, y, dt, curvature: As `LoadedShape.forward` has them.

        Returns:
            The next state, and q_bar (..., n).
        """
        shape = self.shape(state.shape, T, usable, oriented, y, dt, curvature)
        points, share = self.curve(shape)
        q_bar = self.fit(self._seed(q_bar, state, pi_hat), pi_hat, points, share)
        lengths = pi_hat + q_bar[..., self.fit.backbone.coordinates.elongations]
        return state._replace(shape=shape, lengths=lengths), q_bar

    def ahead(
        self, state: FollowedShape, x: Tensor, e: Tensor, xdot_d: Tensor, dt: Tensor
    ) -> tuple[FollowedShape, Tensor]:
        """The error that the loop acts on: as it will be in T s, at the speeds that tip and target have.

        T = m / M sqrt(L / g): m is the load as it is estimated, M the arm's mass, and sqrt(L / g) the time in which
        what stands on a length L topples; an arm without load is seen as it is. The error is e - w,

            w = x - x_late - T xdot_d,

        x_late being x behind a low-pass of T. Of w only what exceeds two standard deviations of `position_noise`
        counts, so a tip that rests is not moved by noise.

        Args:
            state: Of a step.
            x: (..., 3) the tip, m.
            e: (..., 3) its error, m.
            xdot_d: (..., 3) of its target, m/s.
            dt: (...) s since the last step.

        Returns:
            The state with x_late of this step, and the error (..., 3), m.
        """
        T = self._topples(state.shape.load).unsqueeze(-1)
        late = torch.where(torch.isfinite(state.tip), state.tip, x)
        late = late + (1.0 - torch.exp(-dt.unsqueeze(-1) / T.clamp(min=1e-6))) * (x - late)
        w = x - late - T * xdot_d
        noise = 2.0 * aligned(self.shape.position_noise, 1)
        counts = (1.0 - noise / torch.linalg.vector_norm(w, dim=-1, keepdim=True).clamp(min=1e-12)).clamp(min=0.0)
        return state._replace(tip=torch.where(torch.isfinite(late), late, state.tip)), e - counts * w

    def _topples(self, load: Tensor) -> Tensor:
        """T (...) of `ahead`, s, under a load (...) at the tip, kg."""
        arm = self.shape.dynamics
        length, mass = (each.to(load).sum(-1) for each in (arm.lengths, arm.masses))
        # Where nothing weighs anything, no load is felt.
        return load / mass.clamp(min=1e-9) * (length / arm.gravity_acceleration.to(load).clamp(min=1e-3)).sqrt()

    def start(self, q: Tensor, pi_hat: Tensor) -> tuple[FollowedShape, Tensor]:
        """`initial_state`, and the strains that it begins with, for a first q_d (..., n) of the shape of q."""
        state = self.initial_state(q, pi_hat)
        strain = self.strain(state)
        # Of one row for arms of many, as a compiler asks, only the form counts.
        return state, strain if strain.shape == q.shape else q

    def infer(
        self,
        feedback: StateFeedback,
        state: FollowedShape,
        q_bar: Tensor,
        pi_hat: Tensor,
        T: Tensor,
        mask: Tensor | None,
        angular_mask: Tensor | None,
        y: Tensor | None,
        dt: Tensor,
        curvature: Tensor | None = None,
    ) -> tuple[FollowedShape, Inference]:
        """`forward` with what algorithm 2 takes, and what the sensors say of its q_bar; unchecked.

        Args:
            feedback: Says which sensors count, and judges.
            state, q_bar, pi_hat, y, dt, curvature: As `forward` has them.
            T, mask, angular_mask: As `StateFeedback.infer` has them.
        """
        pi_hat, seen = self._seen(feedback, q_bar, pi_hat, T, mask, angular_mask, curvature)
        batch, problem = pi_hat.shape[:-1], seen.problem
        q_bar = q_bar.expand(*batch, q_bar.shape[-1])
        y = None if y is None else y.expand(*batch, y.shape[-1])
        later, found = self(
            state, q_bar, pi_hat, seen.T, problem.usable, seen.oriented, y, dt.expand(batch), seen.curvature
        )
        problem = problem._replace(points=self.sensors_on(later.shape, found, pi_hat))
        step = torch.cat(
            (found - self._seed(q_bar, state, pi_hat), self.shape.change(state.shape, later.shape)), dim=-1
        )
        misfit, untold = later.shape.misfit > MISFIT**2, self.shape.untold(later.shape)
        return later, feedback.judged(found, pi_hat, problem, step.abs().amax(-1), misfit, seen.told, untold)

    def covariance(
        self,
        feedback: StateFeedback,
        state: FollowedShape,
        q_bar: Tensor,
        pi_hat: Tensor,
        T: Tensor,
        mask: Tensor | None,
        angular_mask: Tensor | None,
        y: Tensor | None,
        dt: Tensor,
        curvature: Tensor | None = None,
    ) -> Tensor:
        """`LoadedShape.covariance` (..., n + 1, n + 1) of what `infer` finds with the same arguments."""
        pi_hat, seen = self._seen(feedback, q_bar, pi_hat, T, mask, angular_mask, curvature)
        told = y, dt.expand(pi_hat.shape[:-1]), seen.curvature
        return self.shape.covariance(state.shape, seen.T, seen.problem.usable, seen.oriented, *told)

    def _seen(
        self,
        feedback: StateFeedback,
        q_bar: Tensor,
        pi_hat: Tensor,
        T: Tensor,
        mask: Tensor | None,
        angular_mask: Tensor | None,
        curvature: Tensor | None,
    ) -> tuple[Tensor, _Seen]:
        """pi_hat and what is measured, of one leading shape, with the inertial units that algorithm 2 does not take."""
        pi_hat, problem = feedback.problem(q_bar.shape[:-1], pi_hat, T, mask, angular_mask)
        oriented = torch.zeros_like(problem.oriented) if feedback.mode == "position" else problem.oriented
        rotation, kinds, told = problem.rotation, self.shape.kinds, None
        if kinds is not None and kinds.inertial:
            turned = counted(T, kinds, mask, angular_mask)[1] & kinds.drifting.to(T.device)
            turned = turned.expand(oriented.shape)
            rotation = torch.where(turned[..., None, None], T[..., :3, :3], rotation)
            oriented, told = oriented | turned, turned.any(-1)
        if curvature is not None:
            curvature = curvature.expand(*pi_hat.shape[:-1], *curvature.shape[-2:])
            known = torch.isfinite(curvature).flatten(-2).any(-1)
            told = known if told is None else told | known
        return pi_hat, _Seen(problem, se3.pose(rotation, problem.position), oriented, curvature, told)

    def _seed(self, q_bar: Tensor, state: FollowedShape, pi_hat: Tensor) -> Tensor:
        """The last q_bar (..., n) with its sections as long as they were: rest lengths may have moved since."""
        return self.fit.backbone.coordinates.with_elongations(q_bar, state.lengths - pi_hat)

    def strain(self, state: FollowedShape) -> Tensor:
        """The bends and elongations of the arm's own sections, as a configuration (..., n) of the model."""
        x, y, elongation = self.shape.strain(state.shape).unflatten(-1, (-1, 3)).unbind(-1)
        coordinates = self.fit.backbone.coordinates
        return coordinates.from_bends(x, y) + coordinates.on_elongations(elongation)

    def driven_lengths(self, pi_hat: Tensor) -> Tensor:
        """Rest lengths (..., n_b) m of the arm's own sections, of the shape of pi_hat."""
        check_tensor("pi_hat", pi_hat, (self.shape.n_sections,))
        return self.fit.nominal.to(pi_hat).expand_as(pi_hat)

    def sensors_on(self, state: ShapeState, q_bar: Tensor, pi_hat: Tensor) -> MaterialPoints:
        """The sensors on the model: as far along it as they are along the arm.

        Its sections are arcs along the shape, not the arm's material, so a rest length does not tell where a sensor is.
        """
        arm, model = self.shape, self.fit.backbone
        q = arm.configuration(state)
        share = arm.share(q, *arm.sensors_at(q))
        sections = model.section_lengths(q_bar, pi_hat)
        return model.material_points(pi_hat, *located(share * sections.sum(-1, keepdim=True), sections))

    def curve(self, state: ShapeState) -> tuple[Tensor, Tensor]:
        """Points (..., N, 3) of the arm, m, `SAMPLES` on each piece, and their shares of its length (..., N)."""
        q, arm = self.shape.configuration(state), self.shape.backbone
        part = torch.arange(1, SAMPLES + 1, device=q.device, dtype=q.dtype) / SAMPLES
        X_tilde = part.repeat(arm.n_sections).expand(*q.shape[:-1], -1)
        piece = torch.arange(arm.n_sections, device=q.device).unsqueeze(-1).expand(-1, SAMPLES).flatten()
        piece = piece.expand(X_tilde.shape)
        chain = arm.chain_to(q, arm.material_points(self.shape.pieces(q), X_tilde, piece))
        return chain.tip, self.shape.share(q, X_tilde, piece)
