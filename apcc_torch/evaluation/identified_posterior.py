"""The most probable shape near the identified arm's equilibrium, under the payload that the shown bodies tell."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import torch
from torch import Tensor

from apcc_torch.evaluation.arm_methods import FOLLOWED, MASS_SPREAD, identification
from apcc_torch.evaluation.frames import Frames
from apcc_torch.evaluation.learning import Estimator, KernelMethod
from apcc_torch.evaluation.method import BOTH, Known
from apcc_torch.evaluation.sections_methods import LEAST_ANGLE, MOST, AffinePosterior, wide
from apcc_torch.evaluation.shape_posterior import POSITION_NOISE, Gaussian, Sections, shrunk_covariance
from apcc_torch.evaluation.stretches import FOLDS, identified_by, outside, stretches
from apcc_torch.evaluation.tasks import Task
from apcc_torch.identification.parameters import Values
from apcc_torch.identification.split import thinned
from apcc_torch.identification.tendon_arm import TIP_MASS, TendonArm
from apcc_torch.lie import so3

ROUNDS = 8
"""Steps of Gauss-Newton's method for the payload."""
LARGEST_STEP = 0.1
"""Of the payload in one of them, kg."""
WEIGHED = 1e-3
"""Change of the payload that its effect is told by, kg."""
MOTORS = Task((), motors=True)


class IdentifiedPosterior(AffinePosterior):
    """Affine sections whose q is normal around the identified arm's equilibrium.

    What is learned beside the arm's parameters is how far q was off that equilibrium: its mean, and the covariance of
    what is left of stretches that identification did not see. It is of bends and of the slopes that the arm's arcs
    lack, so of positions and orientations together. Sections are as identified or, where they end at the bodies, as
    calibrated at rest, whichever leaves less there. The payload is the most likely one given the shown bodies of all
    moments that are asked for, and the motors.
    """

    def answers(self, task: Task) -> bool:
        """See `Method.answers`."""
        return super().answers(task) and task.motors

    def fit(self, train: Frames) -> None:
        """See `Method.fit`."""
        found = identification(self.known, train)
        self.values = self.known.values(found)
        self.arm = TendonArm(self.known.arm)
        candidates = [self.identified_sections()]
        if self.arm.at_tips and list(self.arm.section) == list(range(len(candidates[0].lengths))):
            candidates.append(self.at_rest())  # its sections are the arm's, one a body
        self.sections = candidates[0]
        some = train.at(thinned(torch.arange(len(train)), MOST))
        rest = self.equilibrium(some, self.values)
        some, rest = some.at(settled(rest)), rest[settled(rest)]
        # What no body tells is as in the equilibrium.
        around = wide(self.sections.model)._replace(value=rest)
        folds = stretches(len(some))
        elsewhere = [
            self.equilibrium(some, identified_by(self.known, some.at(outside(folds, k)), found)) for k in range(FOLDS)
        ]
        tried = []
        for sections in candidates:
            q = sections.most_probable(some.positions, some.rotations, [around])
            tried.append((shrunk_covariance(self.missed(some, q, folds, elsewhere)), sections, q - rest))
        scatter, self.sections, off = min(tried, key=lambda each: float(each[0].logdet()))
        self.learn(some, off)
        self.left = Gaussian.around(self.mean, scatter, LEAST_ANGLE)

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
        return Sections(self.model(len(lengths)), lengths, calibration)

    def missed(self, some: Frames, q: Tensor, folds: Tensor, elsewhere: Sequence[Tensor]) -> Tensor:
        """How far q (N, n) was off what the other stretches tell (M, n), where there is an equilibrium.

        Args:
            some: The moments.
            q: What was seen of them.
            folds: (N,) stretch of each.
            elsewhere: Of each stretch, all equilibria (N, n) of an arm identified without it.
        """
        missed = []
        for fold, rest in enumerate(elsewhere):
            off, own, others = q - rest, (folds == fold).nonzero().squeeze(-1), outside(folds, fold)
            own, others = (index[settled(off[index])] for index in (own, others))
            missed.append(off[own] - self.told(some.at(others), off[others], some.at(own)))
        return torch.cat(missed)

    def learn(self, frames: Frames, off: Tensor) -> None:
        """What is believed of q less its equilibrium, from examples (N, n)."""
        self.mean = off.mean(0)

    def told(self, learned: Frames, off: Tensor, asked: Frames) -> Tensor:
        """What examples (N, n) of q less its equilibrium say of other moments (M, n)."""
        return off.mean(0).expand(len(asked), -1)

    def equilibrium(self, frames: Frames, values: Values) -> Tensor:
        """q (N, n) of the identified arm at rest, whose arcs have no slopes; NaN where there is none."""
        q, coordinates = self.arm.rest(frames.drive, values), self.sections.model.coordinates
        driven = torch.tensor([each.driven for each in coordinates.pattern]).repeat(len(self.sections.lengths))
        return q.new_zeros(len(q), len(driven)).index_copy(1, driven.nonzero().squeeze(-1), q)

    def predict(self, test: Frames, task: Task, seen: Frames | None = None) -> Tensor:
        """See `Method.predict`."""
        q = self.expected(test, self.payload(test))
        belief = self.left._replace(value=torch.where(q.isfinite(), q, self.left.value))
        return self.sections.positions(self.sections.most_probable(test.positions, test.rotations, [belief]))

    def expected(self, frames: Frames, payload: Tensor) -> Tensor:
        """q (N, n) under the motors and a payload (1,), kg; NaN where there is no equilibrium."""
        return self.equilibrium(frames, self.values | {TIP_MASS: payload}) + self.mean

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
    """The same, with what is left of q told by kernel ridge regression from the motors."""

    family = BOTH

    def __init__(self, known: Known) -> None:
        super().__init__(known)
        self.regression = KernelMethod(known)

    def learn(self, frames: Frames, off: Tensor) -> None:
        """See `IdentifiedPosterior.learn`."""
        super().learn(frames, off)
        self.rest = self.regression.learned(frames, off - self.mean, MOTORS)

    def told(self, learned: Frames, off: Tensor, asked: Frames) -> Tensor:
        """See `IdentifiedPosterior.told`."""
        return self._said(self.regression.learned(learned, off, MOTORS), asked)

    def expected(self, frames: Frames, payload: Tensor) -> Tensor:
        """See `IdentifiedPosterior.expected`."""
        return super().expected(frames, payload) + self._said(self.rest, frames)

    def _said(self, model: Estimator, frames: Frames) -> Tensor:
        return torch.from_numpy(model.predict(self.regression.features(frames, MOTORS)))


def settled(q: Tensor) -> Tensor:
    """Indices of the moments whose equilibrium (N, n) was found."""
    return q.isfinite().all(-1).nonzero().squeeze(-1)
