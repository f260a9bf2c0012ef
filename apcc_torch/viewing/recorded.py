"""A finished run as moments: what its folder or log says of every instant."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from apcc_torch.viewing.drawn_size import DrawnSize
from apcc_torch.viewing.moment import Array, Moment
from apcc_torch.viewing.outline import Outline


@dataclass(frozen=True, kw_only=True)
class Recorded:
    """A run, time first; R rows.

    name: What it is called. size: Of the arm. time: (T,) s. x_d: (T, R, 3) m.
    error: (T, R) m, from the tip to the target; NaN where it is not known.
    arm: Outline of what is drawn as the arm. q: (T, R, n) its configuration. lengths: (n_b,) its rest lengths, m, or
        (T, R, n_b) where they change.
    model: Outline of the controller's model; None where it is the arm that is drawn. q_bar: (T, R, m), its
        configuration. pi_hat: (T, R, m_b), its rest lengths, m.
    abscissae: (k,) of the sensors on the drawn arm, m; None where `poses` are measured.
    poses: (T, R, k, 4, 4) measured, NaN where one is not. noise: m, their standard deviation; 0 where it is not known.
    tension: (T, R, n_a) N; None where it is not known.
    rows: What tells the rows apart, R texts.
    """

    name: str
    size: DrawnSize
    time: Tensor
    x_d: Tensor
    error: Tensor
    arm: Outline
    q: Tensor
    lengths: Tensor
    model: Outline | None
    q_bar: Tensor
    pi_hat: Tensor
    abscissae: Tensor | None = None
    poses: Tensor | None = None
    noise: float = 0.0
    tension: Tensor | None = None
    rows: tuple[str, ...] = ("",)

    @property
    def sections(self) -> int:
        """Sections of the drawn arm that are told apart."""
        return self.arm.sections

    def nearest(self, time: float) -> int:
        """Index of the instant nearest to a time, s."""
        return int((self.time - time).abs().argmin())

    def moment(self, k: int, row: int) -> Moment:
        """One instant of one row."""
        with torch.inference_mode():
            q, lengths = self.q[k, row], self.lengths if self.lengths.dim() == 1 else self.lengths[k, row]
            sections, tendons = self.arm(q, lengths)
            if self.poses is not None:
                sensors: Array | None = self.poses[k, row].numpy()
            else:
                sensors = None if self.abscissae is None else self.arm.poses(q, lengths, self.abscissae)
            covariance = None
            if self.noise and sensors is not None:
                covariance = np.broadcast_to(self.noise**2 * np.eye(3), (len(sensors), 3, 3))
            return Moment(
                sections,
                tendons,
                None if self.tension is None else self.tension[k, row].numpy(),
                sensors,
                covariance,
                None if self.model is None else self.model.centre_line(self.q_bar[k, row], self.pi_hat[k, row]),
                self.x_d[k, row].numpy(),
            )
