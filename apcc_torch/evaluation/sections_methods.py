"""Methods that know the arm's geometry: sections through the bodies that are seen, and the motors as rows on them."""

from __future__ import annotations

from typing import ClassVar

import torch
from torch import Tensor

from apcc_torch.errors import ConfigError
from apcc_torch.evaluation.frames import Frames
from apcc_torch.evaluation.method import Method
from apcc_torch.evaluation.shape_posterior import Gaussian, Sections
from apcc_torch.evaluation.tasks import Task
from apcc_torch.identification.split import thinned
from apcc_torch.model.affine import AffineBackbone
from apcc_torch.model.backbone import PCCBackbone
from apcc_torch.model.kinematic_model import KinematicModel

WIDE = (2.0, 0.02)
"""Deviations of a prior that only keeps a shape determined: of angles, rad, and of elongations, m."""
LEAST_ANGLE, LEAST_INPUT = 1e-4, 1e-3
"""Deviations that what is learned has at least: of q, rad and m; of inputs, in their unit."""
MOST = 1500
"""Moments that are learned from."""


def wide(model: KinematicModel) -> Gaussian:
    """A prior around the straight shape."""
    deviation = model.coordinates.per_unit(*WIDE, model.n, torch.zeros(model.n, dtype=torch.float64))
    eye = torch.eye(model.n, dtype=torch.float64)
    return Gaussian(torch.zeros_like(deviation), eye, torch.diag(1.0 / deviation))


class Posterior(Method):
    """The most probable q of constant-curvature sections that end at the bodies, lengths as measured at rest.

    What is learned: a normal prior of q, and the inputs as A q + b with their covariance, by least squares. So motors
    are rows beside the sensors, weighed by how well they tell the shape.
    """

    model: ClassVar[type[PCCBackbone] | type[AffineBackbone]] = PCCBackbone

    def answers(self, task: Task) -> bool:
        """See `Method.answers`."""
        return bool(task.shown) and not task.online

    def fit(self, train: Frames) -> None:
        """See `Method.fit`."""
        self.sections = self.at_rest()
        some = train.at(thinned(torch.arange(len(train)), MOST))
        q = self.sections.most_probable(some.positions, some.rotations, [wide(self.sections.model)])
        self.prior = Gaussian.of(q, LEAST_ANGLE)
        self.inputs = Gaussian.regressed(q, some.inputs, LEAST_INPUT)

    def at_rest(self) -> Sections:
        """Sections that end at the bodies, as they were calibrated."""
        lengths = self.known.calibration.rest_lengths
        return Sections(self.model(len(lengths)), lengths, self.known.calibration)

    def predict(self, test: Frames, task: Task, seen: Frames | None = None) -> Tensor:
        """See `Method.predict`."""
        beliefs = [self.prior]
        if task.motors:
            beliefs.append(self.inputs._replace(value=test.inputs - self.inputs.value))
        return self.sections.positions(self.sections.most_probable(test.positions, test.rotations, beliefs))


class AffinePosterior(Posterior):
    """The same with curvature that varies affinely along each section."""

    model = AffineBackbone


class ThroughSensors(Method):
    """Sections that end at the bodies that are seen, the last at the arm's end, and pass through them; none learns."""

    model: ClassVar[type[PCCBackbone] | type[AffineBackbone]] = PCCBackbone

    def answers(self, task: Task) -> bool:
        """See `Method.answers`."""
        return bool(task.shown) and not task.motors

    def fit(self, train: Frames) -> None:
        """See `Method.fit`."""

    def predict(self, test: Frames, task: Task, seen: Frames | None = None) -> Tensor:
        """See `Method.predict`."""
        return self.through(test, self.ends(task))

    def ends(self, task: Task) -> Tensor:
        """Abscissae at which the sections end (n_b,), m."""
        X = self.known.calibration.abscissae
        return torch.cat((X[list(task.shown[:-1])], X[-1:]))

    def through(self, test: Frames, ends: Tensor) -> Tensor:
        """Positions of all bodies on sections that end at the abscissae `ends` (n_b,)."""
        model = self.model(len(ends))
        sections = Sections(model, ends.diff(prepend=ends.new_zeros(1)), self.known.calibration)
        return sections.positions(sections.most_probable(test.positions, test.rotations, [wide(model)]))


class AffineThroughSensors(ThroughSensors):
    """The same with curvature that varies affinely along each section."""

    model = AffineBackbone


class Spline(ThroughSensors):
    """A cubic spline over the abscissa, from the base and along its axis through the bodies that are seen."""

    def predict(self, test: Frames, task: Task, seen: Frames | None = None) -> Tensor:
        """See `Method.predict`."""
        try:
            from scipy.interpolate import CubicSpline
        except ImportError as error:
            raise ConfigError('it needs scipy: pip install "apcc-torch[evaluate]"') from error
        base, shown = self.known.calibration, list(task.shown)
        # Each marker's place beside the axis, which does not turn here, is taken off and put back.
        beside = base.points(self.at_rest())
        beside = beside - torch.nn.functional.pad(base.abscissae.unsqueeze(-1), (2, 0))
        points = torch.nn.functional.pad((base.points(test.positions) - beside)[:, shown], (0, 0, 1, 0))
        at = torch.nn.functional.pad(base.abscissae[shown], (1, 0))
        start, end = points.new_tensor([0.0, 0.0, 1.0]).expand(len(points), 3), points.new_zeros(len(points), 3)
        curve = CubicSpline(at.numpy(), points.numpy(), axis=1, bc_type=((1, start.numpy()), (2, end.numpy())))
        found = torch.from_numpy(curve(base.abscissae.numpy())) + beside
        return found @ base.base_rotation.mT + base.base_position

    def at_rest(self) -> Tensor:
        """Where the bodies of the straight arm are (k, 3), m, recording frame."""
        model = PCCBackbone(1)
        arm = Sections(model, self.known.calibration.abscissae[-1:], self.known.calibration)
        return arm.positions(torch.zeros(1, model.n, dtype=torch.float64))[0]


class BestLengths(ThroughSensors):
    """The same as constant curvature with those lengths that turn out best, which nobody can know before."""

    hindsight = True
    SHARES: ClassVar[tuple[float, ...]] = (0.7, 0.8, 0.9, 1.0, 1.1, 1.2, 1.3)

    def answers(self, task: Task) -> bool:
        """See `Method.answers`."""
        return super().answers(task) and len(task.shown) > 1

    def predict(self, test: Frames, task: Task, seen: Frames | None = None) -> Tensor:
        """See `Method.predict`."""
        assert seen is not None, "hindsight needs the answers"
        ends, hidden = self.ends(task), list(task.hidden(test.positions.shape[1]))
        lengths = ends.diff(prepend=ends.new_zeros(1))
        found: list[tuple[float, Tensor]] = []
        for shares in torch.cartesian_prod(*[ends.new_tensor(self.SHARES)] * (len(ends) - 1)).view(-1, len(ends) - 1):
            first = lengths[:-1] * shares
            rest = ends[-1:] - first.sum(-1, keepdim=True)
            if float(rest) <= 0.0:
                continue
            there = self.through(test, torch.cat((first, rest)).cumsum(0))
            error = (there - seen.positions)[:, hidden].square().sum(-1).mean()
            found.append((float(error), there))
        return min(found, key=lambda each: each[0])[1]
