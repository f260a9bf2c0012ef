"""The most probable shape near the identified arm's equilibrium, under the payload that the shown bodies tell."""

from __future__ import annotations

from dataclasses import replace

import torch
from torch import Tensor

from apcc_torch.evaluation.arm_methods import FOLLOWED, MASS_SPREAD, identified
from apcc_torch.evaluation.frames import Frames
from apcc_torch.evaluation.learning import Estimator, KernelMethod
from apcc_torch.evaluation.method import BOTH
from apcc_torch.evaluation.sections_methods import LEAST_ANGLE, MOST, Posterior, wide
from apcc_torch.evaluation.shape_posterior import POSITION_NOISE, Gaussian, Sections
from apcc_torch.evaluation.tasks import Task
from apcc_torch.identification.split import thinned
from apcc_torch.identification.tendon_arm import TIP_MASS, TendonArm
from apcc_torch.lie import so3
from apcc_torch.model.backbone import PCCBackbone

ROUNDS = 8
"""Steps of Gauss-Newton's method for the payload."""
LARGEST_STEP = 0.1
"""Of the payload in one of them, kg."""
WEIGHED = 1e-3
"""Change of the payload that its effect is told by, kg."""
FOLDS = 3
"""Stretches of what is learned from, each held back once, that say how far a regression is off."""
MOTORS = Task((), motors=True)


class IdentifiedPosterior(Posterior):
    """Sections of the identified arm, whose q is normal around its equilibrium under the motors.

    What is learned beside the arm's parameters is how far q was off that equilibrium: mean and covariance. The payload
    is the most likely one given the shown bodies of all moments that are asked for, and the motors.
    """

    def answers(self, task: Task) -> bool:
        """See `Method.answers`."""
        return super().answers(task) and task.motors

    def fit(self, train: Frames) -> None:
        """See `Method.fit`."""
        self.values = {name: value.detach() for name, value in identified(self.known, train).items()}
        self.arm = TendonArm(self.known.arm)
        self.sections = self.identified_sections()
        some = train.at(thinned(torch.arange(len(train)), MOST))
        q = self.sections.most_probable(some.positions, some.rotations, [wide(self.sections.model)])
        rest = self.arm.rest(some.drive, self.values)
        settled = rest.isfinite().all(-1)
        self.left = self.learned(some.at(settled.nonzero().squeeze(-1)), (q - rest)[settled])

    def learned(self, frames: Frames, left: Tensor) -> Gaussian:
        """What is believed of q less its equilibrium, from examples (N, n)."""
        return Gaussian.of(left, LEAST_ANGLE)

    def identified_sections(self) -> Sections:
        """Sections with the identified arm's geometry: its lengths, base, and where bodies sit on it."""
        lengths, base = self.values["rest_length"], so3.exp(self.values["base_rotation"])
        told = self.known.calibration
        at = (lengths.cumsum(0) - lengths)[self.arm.section] + self.arm.X_tilde * lengths[self.arm.section]
        # A mount is given in the model's axes, a calibration's offset in the sensor's.
        turned = told.mount_rotation @ told.base_rotation.mT @ base
        offset = -(turned @ self.values["mount"].view(-1, 3, 1)).squeeze(-1)
        calibration = replace(
            told, base_position=self.values["base_position"], base_rotation=base, mount_rotation=turned,
            mount_offset=offset, abscissae=at,
        )  # fmt: skip
        return Sections(PCCBackbone(len(lengths)), lengths, calibration)

    def predict(self, test: Frames, task: Task, seen: Frames | None = None) -> Tensor:
        """See `Method.predict`."""
        q = self.expected(test, self.payload(test))
        belief = self.left._replace(value=torch.where(q.isfinite(), q, self.left.value))
        return self.sections.positions(self.sections.most_probable(test.positions, test.rotations, [belief]))

    def expected(self, frames: Frames, payload: Tensor) -> Tensor:
        """q (N, n) under the motors and a payload (1,), kg; NaN where there is no equilibrium."""
        return self.arm.rest(frames.drive, self.values | {TIP_MASS: payload}) + self.left.value

    def payload(self, test: Frames) -> Tensor:
        """The most likely payload (1,), kg: bodies scatter by what q does, and by the noise of their positions."""
        some = test.at(thinned(torch.arange(len(test)), FOLLOWED))
        places = self.sections.calibration.points(some.positions)
        covariance = torch.linalg.inv(self.left.root.mT @ self.left.root)
        mass = places.new_zeros(1)
        for _ in range(ROUNDS):
            q, heavier = (self.expected(some, mass + more) for more in (0.0, WEIGHED))
            p, _, slope = self.sections.bodies(q)
            usable = places.isfinite().all(-1) & (q + heavier).isfinite().all(-1, keepdim=True)
            rows = usable.unsqueeze(-1).expand_as(p).flatten(1)
            J = torch.where(rows.unsqueeze(-1), slope[..., 3:, :].flatten(1, 2), 0.0)
            off = torch.where(rows, (places - p).flatten(1), 0.0).unsqueeze(-1)
            moved = J @ ((heavier - q) / WEIGHED).nan_to_num().unsqueeze(-1)
            scatter = J @ covariance @ J.mT + POSITION_NOISE**2 * torch.eye(J.shape[1], dtype=J.dtype)
            weighed = torch.linalg.solve(scatter, moved).mT
            slope_of_mass = (weighed @ moved).sum() + MASS_SPREAD**-2
            step = ((weighed @ off).sum() - mass * MASS_SPREAD**-2) / slope_of_mass
            mass = (mass + step.clamp(-LARGEST_STEP, LARGEST_STEP)).clamp(min=0.0)
        return mass


class LearnedPosterior(IdentifiedPosterior):
    """The same, with the mean of what is left of q told by kernel ridge regression from the motors."""

    family = BOTH

    def learned(self, frames: Frames, left: Tensor) -> Gaussian:
        """See `IdentifiedPosterior.learned`; the covariance is of what it leaves where it has not learned."""
        self.regression = KernelMethod(self.known)
        self.rest = self._model(frames, left)
        folds = torch.arange(len(left)) * FOLDS // len(left)
        missed = torch.empty_like(left)
        for fold in range(FOLDS):
            own, others = ((folds == fold).nonzero().squeeze(-1), (folds != fold).nonzero().squeeze(-1))
            missed[own] = left[own] - self._said(self._model(frames.at(others), left[others]), frames.at(own))
        return Gaussian.of(missed, LEAST_ANGLE)

    def expected(self, frames: Frames, payload: Tensor) -> Tensor:
        """See `IdentifiedPosterior.expected`."""
        return super().expected(frames, payload) + self._said(self.rest, frames)

    def _model(self, frames: Frames, left: Tensor) -> Estimator:
        return self.regression.learned(frames, left, MOTORS)

    def _said(self, model: Estimator, frames: Frames) -> Tensor:
        return torch.from_numpy(model.predict(self.regression.features(frames, MOTORS)))
