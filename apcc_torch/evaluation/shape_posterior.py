"""The most probable shape of sections from bodies that are seen, a prior of q, and rows that are linear in q."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import torch
from torch import Tensor

from apcc_torch.estimation.rest_calibration import RestCalibration
from apcc_torch.identification.fit import correlation_length
from apcc_torch.lie import so3
from apcc_torch.model.abscissae import located
from apcc_torch.model.kinematic_model import KinematicModel

POSITION_NOISE, ROTATION_NOISE = 3e-4, 0.02
"""What a body's position and orientation are trusted to: m, of motion capture; rad, with the torsion no arc has."""
LARGEST_STEP = 0.3
"""Of a coordinate in one step, rad or m."""
SETTLED = 1e-7
"""Largest change of a coordinate, rad or m, with which the iteration ends..."""
STEPS = 40
"""...or after so many."""


class Gaussian(NamedTuple):
    """What is believed of numbers linear in q: root @ (value - matrix @ q) is standard normal.

    value: (..., m). matrix: (m, n). root: (m, m), of the information: root^T root is the inverse covariance.
    """

    value: Tensor
    matrix: Tensor
    root: Tensor

    @staticmethod
    def of(samples: Tensor, least: float) -> Gaussian:
        """Of q itself, by the mean and covariance of samples (N, n) and a deviation that it has at least."""
        mean = samples.mean(0)
        return Gaussian.around(mean, covariance(samples - mean), least)

    @staticmethod
    def around(mean: Tensor, scatter: Tensor, least: float) -> Gaussian:
        """Of q itself, by its mean (n,), covariance (n, n), and a deviation that it has at least."""
        return Gaussian(mean, torch.eye(len(mean), dtype=mean.dtype), information_root(scatter, least))

    @staticmethod
    def regressed(q: Tensor, values: Tensor, least: float) -> Gaussian:
        """Of numbers (N, m) by their least squares on q (N, n); the value of other moments less `value` is theirs."""
        ones = torch.nn.functional.pad(q, (0, 1), value=1.0)
        solution = torch.linalg.lstsq(ones, values).solution
        root = information_root(shrunk_covariance(values - ones @ solution), least)
        return Gaussian(solution[-1], solution[:-1].mT, root)


def covariance(residual: Tensor) -> Tensor:
    """Of residuals (N, m) with zero mean, (m, m)."""
    return residual.mT @ residual / len(residual)


def shrunk_covariance(residual: Tensor) -> Tensor:
    """The same of what a model leaves in the order of time, of which few moments say little.

    Correlations shrink by the share of their squares that chance alone would make (Schaefer and Strimmer 2005, target
    D), with as many moments as are worth an independent one.
    """
    found = covariance(residual)
    scale = found.diagonal().sqrt().clamp(min=torch.finfo(found.dtype).tiny)
    apart = ~torch.eye(len(scale), dtype=torch.bool)
    squared = (found / scale / scale.unsqueeze(-1)).square()[apart]
    independent = len(residual) / correlation_length(residual / scale)
    by_chance = (1.0 - squared).square().sum() / independent
    kept = 1.0 - (by_chance / squared.sum().clamp(min=1e-12)).clamp(max=1.0)
    return torch.where(apart, kept * found, found)


def information_root(scatter: Tensor, least: float) -> Tensor:
    """Upper root (m, m) of the inverse of a covariance (m, m), and of a deviation that each number has at least."""
    eye = torch.eye(len(scatter), dtype=scatter.dtype)
    return torch.linalg.cholesky(torch.linalg.inv(scatter + least * least * eye)).mT


@dataclass(frozen=True)
class Sections:
    """An arm of sections whose bodies sit where they were calibrated at rest; they turn with it.

    model: Of n coordinates. lengths: (n_b,) m. calibration: Of the k bodies.
    """

    model: KinematicModel
    lengths: Tensor
    calibration: RestCalibration

    def bodies(self, q: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Positions (N, k, 3) in the base's frame, rotations (N, k, 3, 3) of the model there, and both's slopes by q.

        The slopes (N, k, 6, n) are those of the turn, in the axes of each body, and of the place, in the base's.
        """
        N, X = len(q), self.calibration.abscissae
        lengths = self.lengths.expand(N, -1)
        points = self.model.material_points(lengths, *located(X.expand(N, -1), lengths))
        chain = self.model.chain_to(q, points)
        # From the model's frame to the body, in the model's axes.
        lever = -(self.calibration.mount_rotation.mT @ self.calibration.mount_offset.unsqueeze(-1)).squeeze(-1)
        turn, move = chain.body_jacobian().split(3, dim=-2)
        moved = chain.rotation @ (move - so3.hat(lever) @ turn)
        places = chain.tip + (chain.rotation @ lever.unsqueeze(-1)).squeeze(-1)
        return places, chain.rotation, torch.cat((turn, moved), dim=-2)

    def positions(self, q: Tensor) -> Tensor:
        """Where the bodies are (N, k, 3), m, recording frame."""
        base = self.calibration
        return self.bodies(q)[0] @ base.base_rotation.mT + base.base_position

    def most_probable(
        self, positions: Tensor, rotations: Tensor, beliefs: list[Gaussian], q: Tensor | None = None
    ) -> Tensor:
        """q (N, n) at N moments, by Gauss-Newton's method on all at once.

        Args:
            positions: (N, k, 3) of the bodies, m, recording frame; NaN: not seen.
            rotations: (N, k, 3, 3) of their axes there; NaN: not seen.
            beliefs: The first is of q itself, and where the iteration begins.
            q: (N, n) where it begins instead.
        """
        base = self.calibration
        places = base.points(positions)
        turned = base.base_rotation.mT @ rotations @ base.mount_rotation
        placed, oriented = places.isfinite(), turned.isfinite().all(-1).all(-1, keepdim=True)
        eye = torch.eye(3, dtype=positions.dtype)
        if q is None:
            q = beliefs[0].value.expand(len(positions), -1)
        for _ in range(STEPS):
            p, R, slope = self.bodies(q)
            turn, moved = slope.split(3, dim=-2)
            off = torch.where(placed, places - p, 0.0) / POSITION_NOISE
            askew = so3.log(torch.where(oriented.unsqueeze(-1), R.mT @ turned, eye)) / ROTATION_NOISE
            rows = [off.flatten(1), askew.flatten(1)]
            slopes = [
                (placed.unsqueeze(-1) * moved / POSITION_NOISE).flatten(1, 2),
                (oriented.unsqueeze(-1) * turn / ROTATION_NOISE).flatten(1, 2),
            ]
            for belief in beliefs:
                rows.append((belief.value - q @ belief.matrix.mT) @ belief.root.mT)
                slopes.append((belief.root @ belief.matrix).expand(len(q), -1, -1))
            J, r = torch.cat(slopes, 1), torch.cat(rows, 1).unsqueeze(-1)
            step = torch.linalg.solve(J.mT @ J, J.mT @ r).squeeze(-1).clamp(-LARGEST_STEP, LARGEST_STEP)
            q = q + step
            if float(step.abs().max()) < SETTLED:
                break
        return q
