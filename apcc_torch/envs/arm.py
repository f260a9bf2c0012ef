"""The arm that the environments move: arm 1 of section V-B, as a model of three sections and a plant of six."""

from __future__ import annotations

from dataclasses import dataclass
from math import pi

import torch
from torch import Tensor

from apcc_torch.control.pid import TendonPID
from apcc_torch.model.backbone import HANGING, PCCBackbone
from apcc_torch.model.dynamics import SoftArmDynamics
from apcc_torch.model.kinematic_model import KinematicModel
from apcc_torch.model.stiffness import scaled_stiffness
from apcc_torch.model.tendons import TendonRouting, rack_routing


@dataclass(frozen=True)
class Arm:
    """Numbers of arm 1, those of conf/robot/arm_1.yaml and conf/plant/arm_1.yaml.

    Sensors and tendon racks sit at the ends of the model's sections. The plant has two sections for each of the model.

    rest_lengths: m, sections of the model; the true ones of the kinematic arm.
    plant_lengths: m, sections of the dynamic arm.
    tendon_offset: m from the backbone.
    tendons_per_rack: Evenly spaced.
    rack_twist: rad, each rack against the one before.
    mass: kg, spread by length.
    axial_stiffness, bending_stiffness: N/m and N m/rad of a section of length `stiffness_reference`, m.
    damping_ratio: s, D = ratio K.
    K_P, K_I, K_D: of the tendon loop, N/m, N/(m s), N s/m.
    tendon_damping: N s/m, friction of each tendon in its guides.
    substeps: Plant steps in one control period of 10 ms. One is within 0.05 mm of eight (conf takes two).
    model: Of the controller that drives the dynamic arm with `action="adaptation"`: a class that is made from a number
        of sections and a base rotation. What else acts, and the kinematic arm, has constant curvature.
    """

    rest_lengths: tuple[float, ...] = (0.105, 0.255, 0.240)
    plant_lengths: tuple[float, ...] = (0.0525, 0.0525, 0.1275, 0.1275, 0.12, 0.12)
    tendon_offset: float = 0.027
    tendons_per_rack: int = 3
    rack_twist: float = pi / 6.0
    mass: float = 1.0
    axial_stiffness: float = 100.0
    bending_stiffness: float = 0.778
    stiffness_reference: float = 0.1
    damping_ratio: float = 0.1
    K_P: float = 750.0
    K_I: float = 1.0
    K_D: float = 5.0
    tendon_damping: float = 200.0
    substeps: int = 1
    model: type[KinematicModel] = PCCBackbone

    @property
    def n_sections(self) -> int:
        """Sections of the model."""
        return len(self.rest_lengths)

    @property
    def n_tendons(self) -> int:
        """Tendons of all racks."""
        return self.n_sections * self.tendons_per_rack

    def lengths(self, like: Tensor) -> Tensor:
        """(n_b,) rest lengths of the model, m, of the dtype and device of `like`."""
        return torch.tensor(self.rest_lengths, dtype=like.dtype, device=like.device)

    def base(self, like: Tensor) -> Tensor:
        """(3, 3) base of the hanging arm in the world."""
        return torch.tensor(HANGING, dtype=like.dtype, device=like.device)

    def routing(self, like: Tensor) -> TendonRouting:
        """The tendons, a rack at the end of every section."""
        return rack_routing(
            self.lengths(like).cumsum(-1), self.tendon_offset, self.tendons_per_rack, self.rack_twist, "coupled"
        )

    def pid(self) -> TendonPID:
        """The loop on the tendons' lengths."""
        return TendonPID(self.K_P, self.K_I, self.K_D)

    def dynamics(self, like: Tensor) -> SoftArmDynamics:
        """The dynamic arm with its nominal lengths and stiffness."""
        lengths = torch.tensor(self.plant_lengths, dtype=like.dtype, device=like.device)
        axial, bending = self.stiffness(lengths)
        return SoftArmDynamics(
            lengths,
            self.masses(lengths),
            axial,
            bending,
            damping_ratio=self.damping_ratio,
            base_rotation=self.base(like),
        )

    def masses(self, lengths: Tensor) -> Tensor:
        """Masses (..., n_t) kg of the plant's sections of these lengths, m."""
        return self.mass * lengths / lengths.sum(-1, keepdim=True)

    def stiffness(self, lengths: Tensor) -> tuple[Tensor, Tensor]:
        """Axial and bending stiffness (..., n_t) of the plant's sections, N/m and N m/rad; softer where longer."""
        return scaled_stiffness(
            lengths, self.stiffness_reference, self.axial_stiffness, self.bending_stiffness, "series"
        )
