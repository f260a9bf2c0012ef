"""Methods that know the arm's tendons: from motors to bodies, as built, identified, and with what the load changes."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import ClassVar

import torch
from torch import Tensor

from apcc_torch.errors import DataError
from apcc_torch.evaluation.frames import Frames
from apcc_torch.evaluation.method import Known, Method
from apcc_torch.evaluation.tasks import Task
from apcc_torch.identification.fit import Fit, fit
from apcc_torch.identification.online import adapt
from apcc_torch.identification.parameters import Block, Parameters, Values
from apcc_torch.identification.split import thinned
from apcc_torch.identification.tendon_arm import TIP_MASS, TendonArm

MASS_SPREAD = 0.5
"""Deviation of the payload before anything is seen, kg."""
FOLLOWED = 150
"""Moments of what is seen under load that its parameters are followed on."""
BY_LOAD = ("pre_stretch",)
"""Blocks that a load changes beside the payload: tendons lie otherwise, and stretch."""


class TendonMethod(Method):
    """An arm driven by its motors: where it comes to rest, with parameters that are given or fitted."""

    kinematic: ClassVar[bool] = False

    def __init__(self, known: Known) -> None:
        super().__init__(known)
        self.arm = TendonArm(known.arm, self.kinematic)
        self.values: Values = known.parameters.values(known.parameters.nominal())

    def answers(self, task: Task) -> bool:
        """See `Method.answers`."""
        return task.motors and not task.shown and not task.online and not task.ahead

    def fit(self, train: Frames) -> None:
        """See `Method.fit`."""

    def predict(self, test: Frames, task: Task, seen: Frames | None = None) -> Tensor:
        """See `Method.predict`."""
        return positions_at_rest(self.arm, test, self.values)


class AsBuilt(TendonMethod):
    """Constant curvature whose bends follow from the tendons' lengths, as the arm's file says."""

    kinematic = True


class IdentifiedGeometry(TendonMethod):
    """The same with its geometry fitted."""

    kinematic = True

    def fit(self, train: Frames) -> None:
        """See `Method.fit`."""
        self.values = identified_geometry(self.known, train)


class FollowedGeometry(TendonMethod):
    """Constant curvature, its geometry fitted to what is seen of the session under load."""

    kinematic = True

    def answers(self, task: Task) -> bool:
        """See `Method.answers`."""
        return task.motors and not task.shown and task.online

    def predict(self, test: Frames, task: Task, seen: Frames | None = None) -> Tensor:
        """See `Method.predict`."""
        assert seen is not None, "what is followed must be seen"
        some, parameters = seen.at(thinned(torch.arange(len(seen)), FOLLOWED)), self.known.geometric
        found = fit(self.arm, parameters, some.drive, some.positions, self.known.fit)
        return positions_at_rest(self.arm, test, parameters.values(found.z))


class IdentifiedArm(TendonMethod):
    """The arm with tendons, stiffness and weight fitted: `python -m apcc_torch.identify`."""

    def fit(self, train: Frames) -> None:
        """See `Method.fit`."""
        self.values = identified(self.known, train)


class IdentifiedAhead(IdentifiedArm):
    """The identified arm one step ahead: it moves on by what the arm does, from where it was at the sample before."""

    def answers(self, task: Task) -> bool:
        """See `Method.answers`."""
        return task.ahead

    def predict(self, test: Frames, task: Task, seen: Frames | None = None) -> Tensor:
        """See `Method.predict`."""
        return moved_on(self.arm, test, self.values)


class OnlineGeometry(TendonMethod):
    """Constant curvature whose geometry, as identified before, is corrected by every scored moment's sample before."""

    kinematic = True

    def answers(self, task: Task) -> bool:
        """See `Method.answers`."""
        return task.ahead

    def fit(self, train: Frames) -> None:
        """See `Method.fit`."""
        self.values = identified_geometry(self.known, train)

    def predict(self, test: Frames, task: Task, seen: Frames | None = None) -> Tensor:
        """See `Method.predict`."""
        parameters = around(self.known.geometric, self.values, tuple(self.values))
        _, scores = adapt(self.arm, parameters, test.past.drive, test.past.positions[:, 0])
        rows = (test.at(torch.tensor([n])) for n in range(len(test)))
        return torch.cat(
            [positions_at_rest(self.arm, row, parameters.values(z)) for row, z in zip(rows, scores, strict=True)]
        )


class IdentifiedUnderLoad(TendonMethod):
    """The identified arm with a payload, and what else a load changes, fitted to what is seen of the session."""

    def answers(self, task: Task) -> bool:
        """See `Method.answers`."""
        return task.motors and not task.shown and task.online

    def fit(self, train: Frames) -> None:
        """See `Method.fit`."""
        self.values = identified(self.known, train)

    def predict(self, test: Frames, task: Task, seen: Frames | None = None) -> Tensor:
        """See `Method.predict`."""
        assert seen is not None, "what is followed must be seen"
        return positions_at_rest(self.arm, test, self.loaded_values(seen))

    def loaded_values(self, seen: Frames) -> Values:
        """The arm's values under the load that was seen."""
        parameters = self.followed()
        return parameters.values(follow(parameters, seen, self.known).z)

    def followed(self) -> Parameters:
        """What is fitted to what is seen."""
        return under_load(self.known.parameters, self.values, BY_LOAD)


class IdentifiedWithMass(IdentifiedUnderLoad):
    """The same with nothing but the payload."""

    def followed(self) -> Parameters:
        """See `IdentifiedUnderLoad.followed`."""
        return under_load(self.known.parameters, self.values, ())


def positions_at_rest(arm: TendonArm, frames: Frames, values: Values) -> Tensor:
    """Where the bodies are (N, k, 3), m.

    Raises:
        DataError: There is a moment at which the arm finds no rest.
    """
    found = arm.predict(frames.drive, values)
    bad = (~found.isfinite().flatten(1).all(-1)).nonzero()
    if len(bad):
        raise DataError(f"the identified arm has no equilibrium at {float(frames.times[int(bad[0])]):.2f} s")
    return found


def moved_on(arm: TendonArm, frames: Frames, values: Values) -> Tensor:
    """Where the bodies are (N, k, 3), m, one step ahead: the model's offset is that of the sample before.

    Raises:
        DataError: There is a moment at which the arm finds no rest.
    """
    before = positions_at_rest(arm, replace(frames, drive=frames.past.drive), values)
    return frames.past.positions[:, 0] + positions_at_rest(arm, frames, values) - before


def identified_geometry(known: Known, train: Frames) -> Values:
    """The geometry of constant curvature whose bends its tendons' lengths tell, fitted to moments of `train`."""
    some, arm = known.some(train), TendonArm(known.arm, kinematic=True)
    found = known.shared("geometry", train, lambda: fit(
        arm, known.geometric, some.drive, some.positions, known.fit, progress=known.say
    ))  # fmt: skip
    return known.geometric.values(found.z)


def identified(known: Known, train: Frames) -> Values:
    """The arm's values after `identification`."""
    return known.parameters.values(identification(known, train).z)


def identification(known: Known, train: Frames) -> Fit:
    """A fit of the arm to moments of `train`; one serves all methods that start from it."""
    some = known.some(train)
    return known.shared("identified", train, lambda: fit(
        TendonArm(known.arm), known.parameters, some.drive, some.positions, known.fit, progress=known.say,
        groups=some.groups,
    ))  # fmt: skip


def around(parameters: Parameters, values: Values, blocks: Sequence[str]) -> Parameters:
    """The same blocks around other values, of which those named are free."""
    held = {
        name: Block(
            values[name], block.spread if name in blocks else 0.0 * block.spread,
            block.unit, block.labels, block.logarithmic,
        )
        for name, block in parameters.blocks.items()
    }  # fmt: skip
    return Parameters(held)


def under_load(parameters: Parameters, values: Values, blocks: Sequence[str]) -> Parameters:
    """Blocks around identified values, of which those named are free, and the payload at the tip, kg."""
    one = values["gravity"].new_ones(1)
    payload = Block(0.0 * one, MASS_SPREAD * one, "kg", ("payload",))
    return Parameters(around(parameters, values, blocks).blocks | {TIP_MASS: payload})


def follow(parameters: Parameters, seen: Frames, known: Known, most: int = FOLLOWED) -> Fit:
    """A fit of what a load changes to moments at which all was seen; one serves all methods that ask for it."""
    some, settings = seen.at(thinned(torch.arange(len(seen)), most)), known.fit.changed(rounds=2)
    return known.shared(
        " ".join(parameters.names),
        some,
        lambda: fit(TendonArm(known.arm), parameters, some.drive, some.positions, settings),
    )
