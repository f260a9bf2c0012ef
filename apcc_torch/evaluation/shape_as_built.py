"""The estimator of the law that ships on a recording: the shape from the bodies that are seen, and mechanics."""

from __future__ import annotations

import torch
from torch import Tensor

from apcc_torch.control.shape_law import ShapeLawSettings
from apcc_torch.estimation.loaded_shape import LoadedShape
from apcc_torch.estimation.shape_state import ShapeMeasurement, ShapeState
from apcc_torch.estimation.tension_prior import tension_scatter
from apcc_torch.evaluation.frames import Frames
from apcc_torch.evaluation.method import Method
from apcc_torch.evaluation.tasks import Task
from apcc_torch.lie import se3

STEPS = 60
"""Steps of the estimator on a moment: it follows an arm with one a period, and here begins anew at each moment."""
PERIOD = 0.05
"""Of one of them, s."""
KNOWN = 1e-9
"""Deviation of a load that is known, kg."""


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
        return self.placed(self.settled(test))

    def settled(self, frames: Frames, y: Tensor | None = None, load: float | Tensor | None = None) -> ShapeState:
        """The shape at all moments, each by itself.

        Args:
            frames: The moments.
            y: (N, n_a) tendon length changes, m, NaN where unknown; None where none is known.
            load: At the tip, kg; None where it is estimated.
        """
        state = self.begun(len(frames))
        for _ in range(STEPS):
            state = self.stepped(held(state, load), self.measured(frames, state, y))
        return held(state, load)

    def measured(self, frames: Frames, state: ShapeState, y: Tensor | None) -> ShapeMeasurement:
        """What is measured of shapes (N) that are about those of `state`."""
        places, axes = (frames.positions - self.base) @ self.upright.mT, self.upright @ frames.rotations
        axes = axes @ self.mount_rotation
        usable, oriented = places.isfinite().all(-1), axes.flatten(-2).isfinite().all(-1)
        position, rotation, beside = self.bodies(state)
        T = se3.pose(
            torch.where(oriented[..., None, None], axes, rotation),
            torch.where(usable.unsqueeze(-1), places - beside, position),
        )
        return ShapeMeasurement(T, usable, oriented, y)

    def stepped(self, state: ShapeState, seen: ShapeMeasurement) -> ShapeState:
        """The shape after a step of the estimator."""
        return self.shape(state, *seen[:4], torch.full_like(state.load, PERIOD))

    def placed(self, state: ShapeState) -> Tensor:
        """Where the bodies are (N, k, 3), m, recording frame."""
        position, _, beside = self.bodies(state)
        return (position + beside) @ self.upright + self.base

    def begun(self, rows: int) -> ShapeState:
        """The arm at rest, at so many moments."""
        lengths = self.shape.dynamics.lengths.unflatten(-1, (-1, self.shape.refine)).sum(-1)
        straight = torch.nn.functional.pad(lengths.unsqueeze(-1), (2, 0)).flatten()
        return self.shape.initial_state((straight + self.shape.rest).expand(rows, -1))

    def bodies(self, state: ShapeState) -> tuple[Tensor, Tensor, Tensor]:
        """Places (N, k, 3) m and axes (N, k, 3, 3) of the arm where bodies sit, and from there to each (N, k, 3)."""
        chain = self.shape.chain_at(self.shape.configuration(state), self.shape.abscissae)
        return chain.tip, chain.rotation, (chain.rotation @ self.lever.unsqueeze(-1)).squeeze(-1)


def held(state: ShapeState, load: float | Tensor | None) -> ShapeState:
    """The state with the load at its tip known, kg; as it is where that is None."""
    if load is None:
        return state
    known = torch.full_like(state.load, KNOWN).unsqueeze(-1)
    deviation = torch.cat((state.deviation[..., :-1], known), dim=-1)
    return state._replace(load=torch.zeros_like(state.load) + load, deviation=deviation)
