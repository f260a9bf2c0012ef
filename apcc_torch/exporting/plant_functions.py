"""The true arm as functions of a library: at rest, and a step later."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor, nn

from apcc_torch.control.pid import TendonReference
from apcc_torch.exporting.functions import Function
from apcc_torch.model.abscissae import decouple
from apcc_torch.simulation.plant import Plant, PlantStep
from apcc_torch.simulation.plant_state import PlantState


class PlantView(NamedTuple):
    """What is seen of a true arm.

    T: (k, 4, 4) poses of the sensors, m. y: (n_a,) lengths that the tendons have, m.
    """

    T: Tensor
    y: Tensor


class PlantAtRest(nn.Module):
    """The arm as it hangs with its tendons at their zero lengths.

    Args:
        state: Of one row, see `Plant.settled`.
    """

    def __init__(self, state: PlantState) -> None:
        super().__init__()
        self.state = state

    def forward(self) -> PlantState:
        """The state."""
        return self.state


class SeenPlantStep(nn.Module):
    """One step of the arm, and what is seen of it then.

    Args:
        plant: Of one row.
        dt: Step, s.
        sensors: (k,) where the sensors are, m.
    """

    X_tilde: Tensor
    j: Tensor

    def __init__(self, plant: Plant, dt: float, sensors: Tensor) -> None:
        super().__init__()
        self.step = PlantStep(plant, dt)
        X_tilde, j = decouple(sensors, plant.dynamics.lengths)
        self.register_buffer("X_tilde", X_tilde)
        self.register_buffer("j", j)

    def forward(self, plant: PlantState, reference: TendonReference) -> tuple[PlantState, PlantView]:
        """The arm one step later, and what is seen of it."""
        true = self.step.plant
        later = self.step(plant, reference)
        T = true.backbone.pose(later.arm.q, true.dynamics.lengths, self.X_tilde, self.j)
        return later, PlantView(T, true.lengths(later.arm.q))


def plant_functions(plant: Plant, dt: float, sensors: Tensor, feed_forward: bool) -> list[Function]:
    """A plant's functions.

    Args:
        plant: Of one row: its payload is ().
        dt: Step, s.
        sensors: (k,) where the sensors are, m.
        feed_forward: Whether the reference of its tendon loop has forces.
    """
    now = plant.settled(plant.settle, dt)
    step = SeenPlantStep(plant, dt, sensors)
    still = torch.zeros_like(now.z)
    pressure = now.held.clone() if plant.sets_pressure else None
    reference = TendonReference(still, still, still if feed_forward else None, pressure)
    return [
        Function("plant_start", "The true arm at rest.", PlantAtRest(now), (), (), ("plant",)),
        Function(
            "plant_step",
            f"The true arm {dt:g} s later.",
            step,
            ("plant", "reference"),
            (now, reference),
            ("plant", "view"),
        ),
    ]
