"""apcc_torch: adaptive piecewise constant-curvature control of soft arms, as batched PyTorch modules.

Everything is a small module whose state is passed in and returned, so the same controller runs in a simulation of
thousands of arms, in the replay of a recording, under autograd, and on the robot.
"""

from __future__ import annotations

import importlib
from typing import Any

import apcc_torch.beginning  # noqa: F401  before what takes a second
from apcc_torch.control.adaptation import AdaptiveLaw, NormalisedLaw
from apcc_torch.control.control_settings import ControlSettings
from apcc_torch.control.controller import APCCController
from apcc_torch.control.inverse_kinematics import InverseKinematics
from apcc_torch.control.length_bounds import LengthBounds
from apcc_torch.control.length_law import LengthLaw
from apcc_torch.control.step_io import Command, ControllerState, Measurement, Target
from apcc_torch.errors import ApccError
from apcc_torch.estimation.feedback import Feedback, FeedbackStatus
from apcc_torch.estimation.savitzky_golay import SavitzkyGolay
from apcc_torch.estimation.state_feedback import StateFeedback
from apcc_torch.model.abscissae import decouple
from apcc_torch.model.affine import AffineBackbone
from apcc_torch.model.arm import Arm
from apcc_torch.model.backbone import PCCBackbone
from apcc_torch.model.constant_strain import ConstantStrainBackbone
from apcc_torch.model.dynamics import SoftArmDynamics
from apcc_torch.model.kinematic_model import KinematicModel
from apcc_torch.model.tendons import TendonRouting
from apcc_torch.part import Part
from apcc_torch.settings import Settings, resolved, setting
from apcc_torch.simulation.metrics import shape_error

__version__ = "0.1.0"

__all__ = [
    "APCCController",
    "AdaptiveLaw",
    "AffineBackbone",
    "ApccError",
    "Arm",
    "Command",
    "ConstantStrainBackbone",
    "ControlSettings",
    "ControllerState",
    "Feedback",
    "FeedbackStatus",
    "InverseKinematics",
    "KinematicModel",
    "LengthBounds",
    "LengthLaw",
    "Measurement",
    "NormalisedLaw",
    "PCCBackbone",
    "Part",
    "SavitzkyGolay",
    "Settings",
    "SoftArmDynamics",
    "StateFeedback",
    "Target",
    "TendonRouting",
    "compose",
    "decouple",
    "resolved",
    "setting",
    "shape_error",
]


def __getattr__(name: str) -> Any:
    """`compose` of apcc_torch.composed, which imports hydra and every part: only once it is asked for."""
    if name != "compose":
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return importlib.import_module("apcc_torch.composed").compose
