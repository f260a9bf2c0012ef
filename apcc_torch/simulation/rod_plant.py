"""A true arm that is no kin of the model's: a Cosserat rod, which twists and shears beside bending and stretching."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from apcc_torch.model.arm import Arm
from apcc_torch.model.arm_dynamics import ArmDynamics
from apcc_torch.model.rod_dynamics import RodDynamics
from apcc_torch.settings import OURS, Setting, aligned, setting
from apcc_torch.simulation.plant import Plant, PlantSettings


@dataclass(frozen=True, kw_only=True)
class RodPlantSettings(PlantSettings):
    """Settings of `RodPlant`."""

    radius: Setting = setting(
        0.027, "m", OURS, "of the round section, and of the circle of rods between discs", rows="number", above=0
    )
    poisson: Setting = setting(0.4, "", OURS, "Poisson's ratio of the material", rows="number", above=-1, most=0.5)
    spacing: Setting | None = setting(
        0.02, "m", OURS, "between the discs that hold the arm's rods; null: a solid section", rows="number", above=0
    )


class RodPlant(Plant):
    """`Plant` as a Cosserat rod of `refine` elements a section; see `RodDynamics`.

    Bends and elongation are as stiff as the arm says. Torsion and shear are those of a structure that bends as stiffly:
    of parallel rods, held a radius from the backbone by discs that they may slide through but not turn in. Where two
    discs are displaced, the rods between bend to an S, G A = 12 E I / s^2; where they are twisted, so does each rod at
    its radius, G J = r^2 G A + E I / (1 + nu). Without a spacing, of a solid round section: G J = E I / (1 + nu),
    G A = 2 E I / ((1 + nu) r^2). Its tendons are those of `Plant`, and feel neither.

    Args:
        dynamics, routing, pid, payload, transmission: See `Plant`.
        *settings, **changes: See `RodPlantSettings`.

    Example:
        >>> plant = RodPlant.on(Arm(lengths=[0.2, 0.25]), torch.tensor([0.0, 0.2]).double(), RodPlantSettings())
        >>> plant.straight((2,)).arm.q.shape
        torch.Size([2, 24])
    """

    settings_type = RodPlantSettings
    radius: Setting
    poisson: Setting
    spacing: Setting | None

    @staticmethod
    def dynamics_of(arm: Arm, settings: Any) -> ArmDynamics:
        """See `Plant.dynamics_of`."""
        axial, bending = arm.section_stiffness(settings.refine)
        r, torsion = aligned(settings.radius, 1), bending / (1.0 + aligned(settings.poisson, 1))
        if settings.spacing is None:
            shear = 2.0 * torsion / r**2
        else:
            shear = 12.0 * bending / aligned(settings.spacing, 1) ** 2
            torsion = torsion + r**2 * shear
        return RodDynamics(
            arm.refined(settings.refine),
            arm.section_masses(settings.refine),
            axial_stiffness=axial,
            bending_stiffness=bending,
            torsional_stiffness=torsion,
            shear_stiffness=shear,
            radius=settings.radius,
            damping_ratio=arm.damping_ratio,
            base_rotation=arm.base_rotation(),
            gravity=arm.placement.acceleration,
        )
