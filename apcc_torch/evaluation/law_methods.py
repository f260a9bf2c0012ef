"""The estimator of the law that ships: the shape from the bodies that are seen, mechanics and the motors."""

from __future__ import annotations

import torch
from torch import Tensor

from apcc_torch.control.shape_law import ShapeLawSettings
from apcc_torch.estimation.loaded_shape import LoadedShape
from apcc_torch.estimation.shape_state import ShapeState
from apcc_torch.estimation.tension_prior import tension_scatter
from apcc_torch.evaluation.arm_methods import identified
from apcc_torch.evaluation.frames import Frames
from apcc_torch.evaluation.method import Method
from apcc_torch.evaluation.tasks import Task
from apcc_torch.identification.arm_blocks import identified_arm
from apcc_torch.identification.tendon_arm import TIP_MASS, TendonArm
from apcc_torch.lie import se3, so3

STEPS = 60
"""Steps of the estimator on a moment: it follows an arm with one a period, and here begins anew at each moment."""
PERIOD = 0.05
"""Of one of them, s."""
WEIGHED = 0.1
"""Payload by which its effect on the tendons is told, kg."""


class ShapeAsBuilt(Method):
    """`LoadedShape` with the law's default settings, of the arm as its file says and as it was measured at rest.

    Nothing is learned. Sections are as long as they were at rest, when tendons may have drawn them together already.
    """

    def answers(self, task: Task) -> bool:
        """See `Method.answers`."""
        return bool(task.shown) and not task.motors

    def fit(self, train: Frames) -> None:
        """See `Method.fit`."""
        told, arm, settings = self.known.calibration, self.known.arm, ShapeLawSettings()
        lengths = arm.rest_lengths() * told.abscissae[-1] / arm.sensor_places()[-1]
        arm = arm.changed(lengths=lengths.tolist(), sensors=told.abscissae.tolist())
        self.upright, self.base = arm.base_rotation() @ told.base_rotation.mT, told.base_position
        self.mount_rotation = told.mount_rotation
        self.lever = -(told.mount_rotation.mT @ told.mount_offset.unsqueeze(-1)).squeeze(-1)
        pieces, tensions = arm.dynamics(settings.refine), tension_scatter(arm)
        self.shape = LoadedShape(pieces, arm.routing(), arm.sensor_places(), settings, tensions=tensions)

    def predict(self, test: Frames, task: Task, seen: Frames | None = None) -> Tensor:
        """See `Method.predict`."""
        places, axes = (test.positions - self.base) @ self.upright.mT, self.upright @ test.rotations
        axes = axes @ self.mount_rotation
        placed, oriented = places.isfinite().all(-1), axes.flatten(-2).isfinite().all(-1)
        told, state = self.tendons_told(test), self.begun(len(test))
        dt = places.new_full((len(test),), PERIOD)
        for _ in range(STEPS):
            position, rotation, beside = self.bodies(state)
            seen_at = torch.where(placed.unsqueeze(-1), places - beside, position)
            T = se3.pose(torch.where(oriented[..., None, None], axes, rotation), seen_at)
            y = None if told is None else told[0] + state.load.median() * told[1]
            state = self.shape(state, T, placed, oriented, y, dt)
        position, _, beside = self.bodies(state)
        return (position + beside) @ self.upright + self.base

    def tendons_told(self, frames: Frames) -> tuple[Tensor, Tensor] | None:
        """Tendon length changes (N, n_a) m without a load, and what each kg adds, m/kg; None where none are told."""
        return None

    def begun(self, rows: int) -> ShapeState:
        """The arm at rest, at so many moments."""
        lengths = self.shape.dynamics.lengths.unflatten(-1, (-1, self.shape.refine)).sum(-1)
        straight = torch.nn.functional.pad(lengths.unsqueeze(-1), (2, 0)).flatten()
        return self.shape.initial_state((straight + self.shape.rest).expand(rows, -1))

    def bodies(self, state: ShapeState) -> tuple[Tensor, Tensor, Tensor]:
        """Places (N, k, 3) m and axes (N, k, 3, 3) of the arm where bodies sit, and from there to each (N, k, 3)."""
        chain = self.shape.chain_at(self.shape.configuration(state), self.shape.abscissae)
        return chain.tip, chain.rotation, (chain.rotation @ self.lever.unsqueeze(-1)).squeeze(-1)


class ShapeIdentified(ShapeAsBuilt):
    """The same of the identified arm, which is told the motors as the tendons' lengths.

    They are those of the arm at rest, under the load that the estimator itself finds: the median over all moments.
    """

    def answers(self, task: Task) -> bool:
        """See `Method.answers`."""
        return bool(task.shown) and task.motors and not task.online

    def fit(self, train: Frames) -> None:
        """See `Method.fit`."""
        self.values = {name: value.detach() for name, value in identified(self.known, train).items()}
        arm, told = identified_arm(self.known.arm, self.values), self.known.calibration
        self.tendons = TendonArm(self.known.arm)
        self.upright, self.base = arm.placement.upright(), self.values["base_position"]
        # Of the straight arm every body has the base's axes.
        self.mount_rotation = told.mount_rotation @ told.base_rotation.mT @ so3.exp(self.values["base_rotation"])
        self.lever = self.values["mount"].view(-1, 3)
        self.shape = LoadedShape.on(arm, ShapeLawSettings())

    def tendons_told(self, frames: Frames) -> tuple[Tensor, Tensor] | None:
        """See `ShapeAsBuilt.tendons_told`; a moment without an equilibrium has NaN, and the shape does without."""
        B = self.tendons.matrix(self.values)
        empty, heavy = (
            self.tendons.rest(frames.drive, self.values | {TIP_MASS: B.new_full((1,), load)}) @ B
            for load in (0.0, WEIGHED)
        )
        return empty, (heavy - empty) / WEIGHED
