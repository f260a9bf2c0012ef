"""An arm whose sections are divided into equal pieces, and the sensors on it."""

from __future__ import annotations

import torch
from torch import Tensor

from apcc_torch.model.abscissae import located
from apcc_torch.model.dynamics import SoftArmDynamics
from apcc_torch.model.kinematic_model import KinematicModel, Placed


class FinerArm:
    """Base of parts that know an arm finer than in sections.

    Attributes:
        dynamics: Of all pieces. backbone: Their model. refine: Pieces of a section. abscissae: (..., k) of the sensors,
            m. uneven: (..., n_f, n) from `uneven_tension`; None where tendons bend each section evenly.
    """

    dynamics: SoftArmDynamics
    backbone: KinematicModel
    refine: int
    abscissae: Tensor
    uneven: Tensor | None

    def _spread(self, strain: Tensor, rest: Tensor | None = None) -> Tensor:
        """S c (..., n_f): each piece takes an equal part of its section's strain, but for what tendons that end within
        the section bend beyond the strain at rest (..., n)."""
        parts = strain.unflatten(-1, (-1, 1, 3)) / self.refine
        even = parts.expand(*strain.shape[:-1], -1, self.refine, 3).flatten(-3)
        if self.uneven is None:
            return even
        bent = strain if rest is None else strain - rest.to(strain)
        return even + (self.uneven.to(strain) @ bent.unsqueeze(-1)).squeeze(-1)

    def _added(self, pieces: Tensor) -> Tensor:
        """A q (..., n) of q (..., n_f): the strains of the sections that their pieces add up to."""
        return pieces.unflatten(-1, (-1, self.refine, 3)).sum(-2).flatten(-2)

    def _gathered(self, J: Tensor) -> Tensor:
        """J S (..., k, r, n) of J (..., k, r, n_f)."""
        even = J.unflatten(-1, (-1, self.refine, 3)).mean(-2).flatten(-2)
        return even if self.uneven is None else even + J @ self.uneven.to(J).unsqueeze(-3)

    def _lengths(self, like: Tensor) -> Tensor:
        """(..., n_b) rest lengths of the sections, m."""
        return self.dynamics.lengths.to(like).unflatten(-1, (-1, self.refine)).sum(-1)

    def _mass(self, like: Tensor) -> Tensor:
        return self.dynamics.masses.to(like).sum(-1)

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
