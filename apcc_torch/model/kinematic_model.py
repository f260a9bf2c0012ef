"""What a controller, an estimator or an experiment needs of a model of an arm's shape, whatever its sections are.

A model is n_b sections in series, whose shape is a configuration q (..., n). Its parameters are the sections' rest
lengths L0 (..., n_b), in which the tip's velocity is linear: J(q, L0) qdot = Y(q, qdot) L0 + Phi(q, qdot). The
elongation delta L of a section adds to its rest length, so Y is the columns of Jdot that belong to the elongations.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import fields
from typing import Any, NamedTuple, Protocol, Self, cast

import torch
from torch import Tensor

from apcc_torch.errors import DtypeError, ShapeError, ValueRangeError
from apcc_torch.lie import se3
from apcc_torch.lie.rotations import is_rotation
from apcc_torch.model.abscissae import MaterialPoints, decouple, section_fractions
from apcc_torch.model.coordinates import Coordinates
from apcc_torch.model.tendons import TendonRouting
from apcc_torch.modes import holds
from apcc_torch.part import Part, hold_rows
from apcc_torch.settings import Settings
from apcc_torch.shapes import batch_shape, broadcast, check_same, check_tensor


class Placed(Protocol):
    """An arm laid out in space up to a point on it, the chain's tip, with what the tip's derivatives share."""

    @property
    def tip(self) -> Tensor:
        """(..., 3) position of the tip, m, world frame."""

    @property
    def rotation(self) -> Tensor:
        """(..., 3, 3) rotation of the tip's frame, whose z axis is the tangent of an arm without shear."""

    def at(self, points: int | slice) -> Placed:
        """Of chains (..., k) to several points, the one to a point, the arm's tip, or those to some of the points."""

    def tip_jacobian(self) -> Tensor:
        """J (..., 3, n): the tip's velocity is J qdot, world axes."""

    def body_jacobian(self) -> Tensor:
        """J_b (..., 6, n): angular, then linear velocity in the tip's own axes, rad/s and m/s."""

    def jacobian_rate(self, qdot: Tensor) -> Tensor:
        """Jdot (..., 3, n) along qdot (..., n), of the leading shape of the chain; chains of whole arms only."""


class PointDerivatives(NamedTuple):
    """Derivatives of functions of the frames of k material points.

    gradient: (..., k, n) by q.
    hessian: (..., k, n, n) by q twice. Rest lengths at fixed fractions act as elongations do.
    slide: (..., k, n) of the gradient as the point slides along its section, per normalised abscissa.
    """

    gradient: Tensor
    hessian: Tensor
    slide: Tensor


class KinematicModel(Part, ABC):
    """Kinematics of n_b sections in series, hung from a base.

    Leading dimensions broadcast. Everything is expressed in the world frame, whose origin is the base of the arm. A
    model of its own defines the abstract methods; those are not checked, and take leading dimensions that are equal.

    Args:
        n_sections: Number of sections n_b.
        coordinates: What a configuration is made of.
        base_rotation: (3, 3) rotation of the arm's base frame in the world; None for the identity.

    Raises:
        ValueRangeError: n_sections < 1, or base_rotation is not a rotation.
        ShapeError: base_rotation is not (3, 3).

    Example:
        >>> models = PCCBackbone(2), AffineBackbone(2), ConstantStrainBackbone(2)
        >>> [(isinstance(model, KinematicModel), model.n) for model in models]
        [(True, 6), (True, 10), (True, 12)]
    """

    base_rotation: Tensor

    def __init__(self, n_sections: int, coordinates: Coordinates, base_rotation: Tensor | None = None) -> None:
        super().__init__()
        if n_sections < 1:
            raise ValueRangeError(f"n_sections must be at least 1, got {n_sections}")
        if base_rotation is None:
            base_rotation = torch.eye(3, dtype=torch.float64)
        check_tensor("base_rotation", base_rotation, (3, 3))
        if not holds(is_rotation(base_rotation.detach().to(torch.float64), 1e-4)):
            raise ValueRangeError("base_rotation must be a rotation matrix (orthonormal, determinant 1)")
        self.n_sections = n_sections
        self.coordinates = coordinates
        hold_rows(self, base_rotation=(base_rotation, 2))

    @classmethod
    def on(cls, n_sections: int, base_rotation: Tensor, settings: Settings) -> Self:
        """The model of so many sections on a base, with the settings of its class, if that has any."""
        own: Any = [settings] if fields(settings) else []
        return cast(Any, cls)(n_sections, base_rotation, *own)

    @property
    @abstractmethod
    def n(self) -> int:
        """Number of configuration variables."""

    @abstractmethod
    def resized(self, n_sections: int) -> KinematicModel:
        """The same kind of model on the same base, with another number of sections."""

    @abstractmethod
    def chain(self, q: Tensor, L0: Tensor) -> Placed:
        """The whole arm: what its tip, the tip's Jacobian and that Jacobian's rate share."""

    @abstractmethod
    def chain_to(self, q: Tensor, points: MaterialPoints) -> Placed:
        """The arm up to each material point, as a chain (..., k) whose tip is that point; q (..., n)."""

    @abstractmethod
    def second_order(
        self, q: Tensor, L0: Tensor, points: MaterialPoints, chain: Any, gradient: Tensor, slope: Tensor
    ) -> PointDerivatives:
        """First and second derivatives of functions of the points' frames; all of one leading shape, unchecked.

        Args:
            q: (..., n).
            L0: (..., n_b) m.
            points: k of them.
            chain: `chain_to` of q and the points.
            gradient: (..., k, 6) of each function by the body twist of its frame, angular part first.
            slope: (..., k, 6, 6) how that changes along the body twist, expressed in the axes of the moved frame.
        """

    @abstractmethod
    def strain(self, q: Tensor, L0: Tensor, points: MaterialPoints) -> Tensor:
        """Body twist (..., k, 6) of a frame that slides past the points, per normalised abscissa of their section."""

    @abstractmethod
    def section_lengths(self, q: Tensor, L0: Tensor) -> Tensor:
        """Lengths (..., n_b) of the sections' curves as they are, m."""

    @abstractmethod
    def tendon_matrix(self, routing: TendonRouting, pi_hat: Tensor) -> Tensor:
        """B(pi_hat) (..., n, n_a): tendon length changes are B^T q, to first order in q. Eqs. (42)-(46) [Dalenberg]."""

    def tendon_lengths(self, routing: TendonRouting, q: Tensor, pi_hat: Tensor) -> Tensor:
        """Tendon length changes y = B^T q (..., n_a), m. Eq. (49) [Dalenberg].

        Args:
            routing: The tendons.
            q: (..., n).
            pi_hat: (..., n_b) m.
        """
        self.check(q, pi_hat)
        return (self.tendon_matrix(routing, pi_hat).mT @ q.unsqueeze(-1)).squeeze(-1)

    def check(self, q: Tensor, L0: Tensor) -> None:
        """Raises ShapeError or DtypeError where q is not (..., n), L0 not (..., n_b), or they do not match."""
        check_tensor("q", q, (self.n,))
        check_tensor("L0", L0, (self.n_sections,))
        check_same(q=q, L0=L0)
        batch_shape(q=(q, 1), L0=(L0, 1))

    def _check_rates(self, q: Tensor, qdot: Tensor) -> None:
        check_tensor("q", q, (self.n,))
        check_tensor("qdot", qdot, (self.n,))
        check_same(q=q, qdot=qdot)
        batch_shape(q=(q, 1), qdot=(qdot, 1))

    def _check_points(self, q: Tensor, L0: Tensor, X_tilde: Tensor, j: Tensor) -> torch.Size:
        """The batch shape of poses at points; raises where q, L0, X_tilde and j do not fit each other."""
        self.check(q, L0)
        check_tensor("X_tilde", X_tilde, (None,))
        check_same(q=q, X_tilde=X_tilde)
        if not isinstance(j, Tensor) or j.dtype != torch.int64:
            raise DtypeError(f"j must be torch.int64, got {getattr(j, 'dtype', type(j).__name__)}")
        if j.shape[-1:] != X_tilde.shape[-1:]:
            raise ShapeError(f"j must have shape (..., {X_tilde.shape[-1]}) as X_tilde has, got {tuple(j.shape)}")
        return batch_shape(q=(q, 1), L0=(L0, 1), X_tilde=(X_tilde, 1), j=(j, 1))

    def _base(self, like: Tensor) -> Tensor:
        return self.base_rotation.to(dtype=like.dtype, device=like.device)

    def _chain(self, q: Tensor, L0: Tensor) -> Placed:
        """`chain` of arguments that are checked, and broadcast."""
        self.check(q, L0)
        batch = broadcast(q.shape[:-1], L0.shape[:-1])
        return self.chain(q.expand(*batch, q.shape[-1]), L0.expand(*batch, L0.shape[-1]))

    def material_points(self, L0: Tensor, X_tilde: Tensor, j: Tensor) -> MaterialPoints:
        """Points (..., k) as parts of the sections, all of one leading shape; unchecked. Arguments as `pose`."""
        fraction = section_fractions(X_tilde, j, self.n_sections)
        return MaterialPoints(fraction, L0.unsqueeze(-2) * fraction, j)

    def tip(self, q: Tensor, L0: Tensor) -> Tensor:
        """Tip position x(q, pi), (..., 3) m, world frame. Eq. (3) [Dalenberg]."""
        return self._chain(q, L0).tip

    def tip_jacobian(self, q: Tensor, L0: Tensor) -> Tensor:
        """J (..., 3, n): tip velocity is J qdot, world frame. Eq. (4) [Dalenberg]."""
        return self._chain(q, L0).tip_jacobian()

    def tip_and_jacobian(self, q: Tensor, L0: Tensor) -> tuple[Tensor, Tensor]:
        """Tip position (..., 3) and Jacobian (..., 3, n) from one pass."""
        chain = self._chain(q, L0)
        return chain.tip, chain.tip_jacobian()

    def tip_jacobian_rate(self, q: Tensor, qdot: Tensor, L0: Tensor) -> Tensor:
        """Jdot (..., 3, n) along qdot; by symmetry of second derivatives also d(J qdot)/dq."""
        self.check(q, L0)
        self._check_rates(q, qdot)
        batch = batch_shape(q=(q, 1), qdot=(qdot, 1), L0=(L0, 1))
        q, qdot, L0 = (v.expand(*batch, v.shape[-1]) for v in (q, qdot, L0))
        return self.chain(q, L0).jacobian_rate(qdot)

    @abstractmethod
    def pose(self, q: Tensor, L0: Tensor, X_tilde: Tensor, j: Tensor) -> Tensor:
        """Poses of material points, h(q, X_tilde, pi). Eq. (27) [Dalenberg].

        Args:
            q: (..., n) configuration.
            L0: (..., n_b) rest lengths, m.
            X_tilde: (..., k) normalised abscissa in its section, from `decouple`.
            j: (..., k) int64 zero-based section index.

        Returns:
            (..., k, 4, 4) world frame.

        Raises:
            ShapeError, DtypeError: The arguments do not fit each other.
        """

    def pose_and_body_jacobian(self, q: Tensor, L0: Tensor, X_tilde: Tensor, j: Tensor) -> tuple[Tensor, Tensor]:
        """Poses (..., k, 4, 4) and body Jacobians (..., k, 6, n) of material points, from one pass.

        Arguments as `pose`. Rows of the Jacobian: angular, then linear velocity in the point's own axes, rad/s and
        m/s. Eqs. (27), (29) [Dalenberg].
        """
        batch = self._check_points(q, L0, X_tilde, j)
        L0, X_tilde, j, q = (v.expand(*batch, v.shape[-1]) for v in (L0, X_tilde, j, q))
        chain = self.chain_to(q, self.material_points(L0, X_tilde, j))
        return se3.pose(chain.rotation, chain.tip), chain.body_jacobian()

    def body_jacobian(self, q: Tensor, L0: Tensor, X_tilde: Tensor, j: Tensor) -> Tensor:
        """J_b (..., k, 6, n) of material points; see `pose_and_body_jacobian`. Eq. (29) [Dalenberg]."""
        return self.pose_and_body_jacobian(q, L0, X_tilde, j)[1]

    def body_parameter_jacobian(self, q: Tensor, L0: Tensor, X: Tensor, body_jacobian: Tensor) -> Tensor:
        """Body twist of material points per unit change of each rest length, with q fixed.

        A longer section moves what it carries as a larger delta L would, and it shifts the point's normalised
        abscissa, which slides the point along its section's strain.

        Args:
            q: (..., n) configuration.
            L0: (..., n_b) rest lengths, m.
            X: (..., k) material abscissae, m.
            body_jacobian: (..., k, 6, n) at the same point, from `pose_and_body_jacobian`.

        Returns:
            (..., k, 6, n_b), rad/m and m/m.
        """
        batch = batch_shape(q=(q, 1), L0=(L0, 1), X=(X, 1))
        L0 = L0.expand(*batch, self.n_sections)
        points = self.material_points(L0, *decouple(X, L0))
        return self.parameter_columns(q.expand(*batch, self.n), L0, X, points, body_jacobian)

    def parameter_columns(
        self, q: Tensor, L0: Tensor, X: Tensor, points: MaterialPoints, body_jacobian: Tensor
    ) -> Tensor:
        """`body_parameter_jacobian` where the points are known; unchecked, q, L0 and points of one leading shape."""
        slide, strain = points.slides(L0, X), self.strain(q, L0, points)
        return body_jacobian[..., self.coordinates.elongations] + strain.unsqueeze(-1) * slide.unsqueeze(-2)

    def points(self, q: Tensor, L0: Tensor, N: int, spacing: str = "arc") -> Tensor:
        """N points along the backbone from base to tip, (..., N, 3) m, world frame.

        Args:
            q: (..., n) configuration.
            L0: (..., n_b) rest lengths, m.
            N: Number of points.
            spacing: "arc", evenly along the curve as it is, so that the points depend on the curve alone; or
                "material", evenly in rest length, so that each is one material point.

        Raises:
            ValueRangeError: N < 2, or an unknown spacing.
        """
        if N < 2:
            raise ValueRangeError(f"N must be at least 2, got {N}")
        if spacing not in ("arc", "material"):
            raise ValueRangeError(f"spacing must be arc or material, got {spacing!r}")
        self.check(q, L0)
        # A section squeezed to nothing holds no points; the floor keeps its neighbours' points finite.
        measure = L0 if spacing == "material" else self.section_lengths(q, L0).clamp(min=1e-9)
        share = torch.linspace(0.0, 1.0, N, dtype=q.dtype, device=q.device)
        X_tilde, j = decouple(share * measure.sum(-1, keepdim=True), measure)
        return self.pose(q, L0, X_tilde, j)[..., :3, 3]

    def curve(self, q: Tensor, L0: Tensor, share: Tensor) -> Tensor:
        """Points (R, 3, N) m at shares (N,) of the curve's length, as `points` has them; unchecked.

        Args:
            q: (R, n).
            L0: (R, n_b) m.
            share: (N,) in [0, 1].
        """
        measure = self.section_lengths(q, L0).clamp(min=1e-9)
        X_tilde, j = decouple(share * measure.sum(-1, keepdim=True), measure)
        return self.pose(q, L0, X_tilde, j)[..., :3, 3].mT

    def regressor(self, q: Tensor, qdot: Tensor) -> tuple[Tensor, Tensor]:
        """Y (..., 3, n_b) and Phi (..., 3) with Y @ L0 + Phi = J(q, L0) qdot. Theorem 1, Eq. (2) [Dalenberg].

        Raises:
            ShapeError, DtypeError: q or qdot is not (..., n), or they do not match.
        """
        self._check_rates(q, qdot)
        q, qdot = torch.broadcast_tensors(q, qdot)
        # Without rest lengths only Phi is left, and what multiplies a rest length multiplies an elongation too.
        chain = self.chain(q, torch.zeros(*q.shape[:-1], self.n_sections, dtype=q.dtype, device=q.device))
        Phi = (chain.tip_jacobian() @ qdot.unsqueeze(-1)).squeeze(-1)
        return chain.jacobian_rate(qdot)[..., self.coordinates.elongations], Phi
