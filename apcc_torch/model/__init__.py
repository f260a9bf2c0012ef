"""Arms: their shape, their tendons, their dynamics and what holds them at rest.

Arms on rigid robots are in `model.mount`, which needs a library that takes long to import.
"""

from __future__ import annotations

from apcc_torch.model.abscissae import decouple
from apcc_torch.model.affine import AffineBackbone, AffineSettings
from apcc_torch.model.arm import Arm
from apcc_torch.model.backbone import PCCBackbone
from apcc_torch.model.chambers import ChamberForce, Chambers
from apcc_torch.model.constant_strain import ConstantStrainBackbone, ConstantStrainSettings
from apcc_torch.model.coordinates import Coordinate, Coordinates
from apcc_torch.model.dynamics import SoftArmDynamics
from apcc_torch.model.dynamics_regressor import DynamicsRegressor
from apcc_torch.model.friction import TendonTransmission, TendonTransmissionSettings
from apcc_torch.model.integrators import Actuation, ArmState, rk4_step, rosenbrock_step, semi_implicit_step
from apcc_torch.model.kinematic_model import KinematicModel
from apcc_torch.model.link_chain import ChainSettings, LinkChain
from apcc_torch.model.loads import Loads
from apcc_torch.model.mjcf import mjcf_text
from apcc_torch.model.static_body import StaticBody
from apcc_torch.model.statics import equilibrium, load_stiffness
from apcc_torch.model.stiffness import scaled_stiffness
from apcc_torch.model.tendons import TendonRouting, rack_routing
from apcc_torch.model.urdf_file import urdf_text

__all__ = [
    "Actuation",
    "AffineBackbone",
    "AffineSettings",
    "Arm",
    "ArmState",
    "ChainSettings",
    "ChamberForce",
    "Chambers",
    "ConstantStrainBackbone",
    "ConstantStrainSettings",
    "Coordinate",
    "Coordinates",
    "DynamicsRegressor",
    "KinematicModel",
    "LinkChain",
    "Loads",
    "PCCBackbone",
    "SoftArmDynamics",
    "StaticBody",
    "TendonRouting",
    "TendonTransmission",
    "TendonTransmissionSettings",
    "decouple",
    "equilibrium",
    "load_stiffness",
    "mjcf_text",
    "rack_routing",
    "rk4_step",
    "rosenbrock_step",
    "scaled_stiffness",
    "semi_implicit_step",
    "urdf_text",
]
