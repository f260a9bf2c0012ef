"""The same estimator on an identified arm, whose motors tell how long its tendons are."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from apcc_torch.control.shape_law import ShapeLawSettings
from apcc_torch.estimation.loaded_shape import LoadedShape
from apcc_torch.evaluation.arm_methods import FOLLOWED, identification
from apcc_torch.evaluation.frames import Frames
from apcc_torch.evaluation.sections_methods import MOST
from apcc_torch.evaluation.shape_as_built import STEPS, ShapeAsBuilt, held
from apcc_torch.evaluation.shape_posterior import shrunk_covariance
from apcc_torch.evaluation.stretches import FOLDS, identified_by, outside, stretches
from apcc_torch.evaluation.tasks import Task
from apcc_torch.identification.arm_blocks import identified_arm
from apcc_torch.identification.fit import Fit
from apcc_torch.identification.split import thinned
from apcc_torch.identification.tendon_arm import TIP_MASS, TendonArm
from apcc_torch.lie import so3

RESTING = 1e-9
"""`load_rate` of a load that hangs there for as long as a session lasts."""
LEAST = 1e-4
"""Deviation of what tendons are off by that they have at least, m."""
WEIGHED = 0.1
"""Payload by which its effect on the tendons is told, kg."""


class Told(NamedTuple):
    """What motors tell of the tendons of an arm at rest, NaN at moments without an equilibrium.

    empty: (N, n_a) length changes without a load, m. heavier: (N, n_a) what each kg at the tip adds, m/kg.
    """

    empty: Tensor
    heavier: Tensor

    def under(self, load: Tensor) -> Tensor:
        """Length changes (N, n_a), m, under a load, kg."""
        return self.empty + load * self.heavier


class ShapeIdentified(ShapeAsBuilt):
    """`LoadedShape` of the identified arm, which is told the motors as the tendons' lengths at rest.

    What is learned beside the arm is how far these are off: the covariance of what they miss in stretches that
    identification did not see, all bodies shown. The load is one for all moments, the most likely: it hangs there for
    as long as the session lasts.
    """

    def answers(self, task: Task) -> bool:
        """See `Method.answers`."""
        return bool(task.shown) and task.motors and not task.online

    def fit(self, train: Frames) -> None:
        """See `Method.fit`."""
        found = identification(self.known, train)
        self.values = self.known.values(found)
        arm, calibrated = identified_arm(self.known.arm, self.values), self.known.calibration
        self.tendons, settings = TendonArm(self.known.arm), ShapeLawSettings(load_rate=RESTING)
        self.B = self.tendons.matrix(self.values)
        self.upright, self.base = arm.placement.upright(), self.values["base_position"]
        # Of the straight arm every body has the base's axes.
        turned = calibrated.base_rotation.mT @ so3.exp(self.values["base_rotation"])
        self.mount_rotation = calibrated.mount_rotation @ turned
        self.lever = self.values["mount"].view(-1, 3)
        self.shape, some = LoadedShape.on(arm, settings), train.at(thinned(torch.arange(len(train)), MOST))
        with torch.no_grad():
            missed = self.missed(some, found)
        eye = torch.eye(arm.n_tendons, dtype=missed.dtype)
        told = (
            shrunk_covariance(missed) + LEAST**2 * eye
            if len(missed) > arm.n_tendons
            else self.shape.tendon_noise**2 * eye
        )
        self.shape = LoadedShape.on(arm, settings, told)

    def missed(self, some: Frames, found: Fit) -> Tensor:
        """How far the lengths that other stretches tell of the tendons are off (M, n_a), m.

        Where bodies leave a strain of a section untold, nothing says how long tendons are.
        """
        state = self.settled(some, load=0.0)
        seen = torch.where(self.shape.untold(state).unsqueeze(-1), torch.nan, self.shape.strain(state) @ self.B)
        folds, missed = stretches(len(some)), []
        for fold in range(FOLDS):
            own = (folds == fold).nonzero().squeeze(-1)
            values = identified_by(self.known, some.at(outside(folds, fold)), found)
            missed.append(self.tendons.rest(some.at(own).drive, values) @ self.B - seen[own])
        off = torch.cat(missed)
        return off[off.isfinite().all(-1)]

    def predict(self, test: Frames, task: Task, seen: Frames | None = None) -> Tensor:
        """See `Method.predict`."""
        load = self.load(test.at(thinned(torch.arange(len(test)), FOLLOWED)))
        return self.placed(self.settled(test, self.told(test).under(load), load))

    def told(self, frames: Frames) -> Told:
        """What motors tell at these moments."""
        empty, heavy = (
            self.tendons.rest(frames.drive, self.values | {TIP_MASS: self.B.new_full((1,), load)}) @ self.B
            for load in (0.0, WEIGHED)
        )
        return Told(empty, (heavy - empty) / WEIGHED)

    def load(self, some: Frames) -> Tensor:
        """The most likely load at the tip, kg, given all these moments.

        By Gauss and Newton's method on all of it, each moment's own strains taken out.
        """
        told, state, weights = self.told(some), self.begun(len(some)), self.shape.tendon_weights
        assert weights is not None, "the shape knows how far tendons are off"
        W, usable = weights[0], told.empty.isfinite().all(-1)
        # Heavier, tendons are told to be longer: r = W (y - B^T q).
        longer = W @ told.heavier.nan_to_num().unsqueeze(-1)
        believed = self.shape.load * self.shape.dynamics.masses.sum()
        load = torch.zeros_like(believed)
        for _ in range(STEPS):
            seen = self.measured(some, state, told.under(load))
            state = held(self.stepped(held(state, load), seen), load)
            r, J = self.shape.residual(state, seen)
            known, off = self.shape.believed(state)
            own, by_load = J.tensor_split((-1,), dim=-1)
            by_load = by_load - torch.nn.functional.pad(longer, (0, 0, by_load.shape[-2] - longer.shape[-2], 0))
            slope = own.mT @ r.unsqueeze(-1) - known @ off.unsqueeze(-1)
            taken = torch.linalg.solve(own.mT @ own + known, torch.cat((own.mT @ by_load, slope), dim=-1))
            left = by_load.mT @ (torch.cat((by_load, r.unsqueeze(-1)), dim=-1) - own @ taken)
            information, wanted = left[usable].sum(0)[0]
            load = load + (wanted - load / believed**2) / (information + believed**-2)
            load = load.clamp(min=0.0)
        return load
