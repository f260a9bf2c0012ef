"""What a plant's statics are worth: shapes of a rod under known weight and wrenches, beside another simulator's."""

from __future__ import annotations

import time
from collections.abc import Callable

import torch
from torch import Tensor

from apcc_torch.errors import ConfigError, DataError
from apcc_torch.evaluation.leaderboard import Score, rms_mm
from apcc_torch.evaluation.method import PHYSICS
from apcc_torch.model.arm import Arm
from apcc_torch.model.arm_dynamics import ArmDynamics
from apcc_torch.model.loads import Loads
from apcc_torch.model.statics import equilibrium
from apcc_torch.recordings.rod_shapes import RodShapes
from apcc_torch.simulation.plant import Plant, PlantSettings
from apcc_torch.simulation.rod_plant import RodPlant, RodPlantSettings

TASK = "weight and wrenches"


def as_sections(arm: Arm, refine: int) -> ArmDynamics:
    """`plant=sections`."""
    return Plant.dynamics_of(arm, PlantSettings(refine=refine))


def as_rod(arm: Arm, refine: int) -> ArmDynamics:
    """`plant=rod`, of the radius that a round section has with the arm's rigidities."""
    axial, bending = arm.section_stiffness()
    radius = 2.0 * float((bending / axial)[0]) ** 0.5
    return RodPlant.dynamics_of(arm, RodPlantSettings(refine=refine, radius=radius))


PLANTS: dict[str, tuple[Callable[[Arm, int], ArmDynamics], int]] = {
    "plant=sections, as in the model": (as_sections, 1),
    "plant=sections, plant.refine=6": (as_sections, 6),
    "plant=rod, plant.refine=3": (as_rod, 3),
    "plant=rod, plant.refine=6": (as_rod, 6),
}
"""Name -> what makes the plant of an arm, and how many pieces each of its sections is cut into."""


def statics_scores(arm: Arm, shapes: RodShapes, session: str) -> list[Score]:
    """Scores of the middle, body 1, and of the tip, body 2; no method learns.

    Args:
        arm: Two halves.
        shapes: Of the rod.
        session: What they are called.

    Raises:
        ConfigError: The arm is not one of two halves.
        DataError: A plant finds no equilibrium.
    """
    if arm.n_sections != 2:
        raise ConfigError(f"arm.lengths must be those of two halves, got {arm.n_sections} sections")
    scores = []
    for name, (make, refine) in PLANTS.items():
        begun = time.process_time()
        ends = half_ends(make(arm, refine), arm, shapes, refine)
        truth = shapes.places[:, :, -1]
        if not bool(ends.isfinite().all()):
            raise DataError(f"{name} finds no equilibrium of a shape")
        scores += [
            Score(
                TASK,
                name,
                PHYSICS,
                session,
                body + 1,
                (rms_mm(ends[:, body], truth[:, body]),),
                time.process_time() - begun,
            )
            for body in range(2)
        ]
    return scores


def half_ends(dynamics: ArmDynamics, arm: Arm, shapes: RodShapes, refine: int) -> Tensor:
    """Where the halves of the rod end (N, 2, 3), m; NaN where there is no equilibrium."""
    wrenches = torch.zeros(len(shapes.tip), 2 * refine, 6, dtype=shapes.tip.dtype)
    wrenches[:, refine - 1], wrenches[:, -1] = shapes.middle, shapes.tip
    weight = shapes.gravity * float(arm.section_masses().sum() / arm.rest_lengths().sum())
    found = equilibrium(dynamics, loads=Loads(distributed=weight, section_wrenches=wrenches))
    X_tilde = torch.ones(2, dtype=weight.dtype)
    places = dynamics.kinematics().pose(found.q, dynamics.lengths, X_tilde, torch.tensor([refine - 1, 2 * refine - 1]))
    return torch.where(found.converged[:, None, None], places[..., :3, 3], torch.nan)
