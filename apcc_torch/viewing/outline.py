"""The outline of an arm or of its model: where its sections, tendons and sensors are at a configuration."""

from __future__ import annotations

import torch
from torch import Tensor

from apcc_torch.model.abscissae import decouple
from apcc_torch.model.kinematic_model import KinematicModel
from apcc_torch.model.tendons import TendonRouting
from apcc_torch.viewing.moment import Array

POINTS = 17
"""Points on each of the sections that are told apart."""


class Outline:
    """Points of a kinematic model, from one call of its poses.

    Args:
        backbone: The model.
        sections: Number of sections that are told apart; each of them is as many of the model's own.
        routing: Tendons beside it; None for none.

    Example:
        >>> arm = Arm(lengths=[0.2, 0.25])
        >>> outline = Outline(arm.backbone(), 2, arm.routing())
        >>> sections, tendons = outline(torch.zeros(6).double(), arm.rest_lengths())
        >>> sections.shape, sections[-1, -1].round(2).tolist(), tendons.shape
        ((2, 17, 3), [0.0, 0.0, -0.45], (6, 34, 3))
    """

    def __init__(self, backbone: KinematicModel, sections: int, routing: TendonRouting | None = None) -> None:
        self.backbone = backbone
        self.sections = sections
        self.routing = routing
        own = backbone.n_sections // sections
        share = torch.linspace(0.0, 1.0, POINTS, dtype=torch.float64) * own
        part = (share.ceil() - 1).clamp(min=0)
        first = own * torch.arange(sections).unsqueeze(-1)
        self.X_tilde = (share - part).repeat(sections)
        self.j = (first + part.long()).flatten()

    def __call__(self, q: Tensor, lengths: Tensor) -> tuple[Array, Array | None]:
        """Centre lines (S, P, 3) of the sections and the tendons' paths (n_a, S P, 3), m, NaN where one is not.

        Args:
            q: (n,) configuration.
            lengths: (n_b,) rest lengths of the model's sections, m.
        """
        X_tilde = self.X_tilde.to(q)
        T = self.backbone.pose(q, lengths, X_tilde, self.j)
        sections = T[:, :3, 3].unflatten(0, (-1, POINTS)).numpy()
        if self.routing is None:
            return sections, None
        begin = lengths.cumsum(-1) - lengths
        X = begin[self.j] + X_tilde * lengths[self.j]
        return sections, self.routing.paths(T, X).numpy()

    def poses(self, q: Tensor, lengths: Tensor, X: Tensor) -> Array:
        """Poses (k, 4, 4) of material points at abscissae X (k,), m."""
        T: Array = self.backbone.pose(q, lengths, *decouple(X.to(q), lengths)).numpy()
        return T

    def centre_line(self, q: Tensor, lengths: Tensor) -> Array:
        """(M, 3) the whole centre line, m."""
        line: Array = self.backbone.points(q, lengths, 48).numpy()
        return line
