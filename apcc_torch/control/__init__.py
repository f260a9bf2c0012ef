"""Controllers and their laws: from estimates and targets to configuration velocities and tendons."""

from __future__ import annotations

from apcc_torch.control.adaptation import AdaptiveLaw, AdaptiveLawSettings, NormalisedLaw, NormalisedLawSettings
from apcc_torch.control.adaptive_dynamics import AdaptiveDynamics, AdaptiveDynamicsSettings
from apcc_torch.control.clearance import ClearanceCost
from apcc_torch.control.composite_controller import CompositeController, CompositeControllerSettings
from apcc_torch.control.control_settings import ControllerSettings, ControlSettings
from apcc_torch.control.controller import APCCController
from apcc_torch.control.estimate_covariance import SensorNoise, estimate_covariance
from apcc_torch.control.inverse_kinematics import InverseKinematics, InverseKinematicsSettings, elongation_cost
from apcc_torch.control.length_bounds import LengthBounds, LengthBoundsSettings
from apcc_torch.control.length_law import LawStep, LengthLaw
from apcc_torch.control.lookahead import Lookahead
from apcc_torch.control.lookahead_controller import LookaheadController
from apcc_torch.control.lookahead_settings import LookaheadSettings
from apcc_torch.control.obstacles import Capsule, HalfSpace, Obstacle, Sphere
from apcc_torch.control.pid import TendonPID, TendonPIDSettings, TendonReference, ramp
from apcc_torch.control.pressure import PressureControl, PressureControlSettings
from apcc_torch.control.shape_law import ShapeLaw, ShapeLawSettings
from apcc_torch.control.step_io import Command, ControllerState, Measurement, Target
from apcc_torch.control.task_controller import TaskController
from apcc_torch.control.task_integral import TaskIntegral, TaskIntegralSettings
from apcc_torch.control.task_stack import TaskStack
from apcc_torch.control.tasks import Task, TaskTarget
from apcc_torch.control.tendon_limits import ConstrainedVelocity, SolverStatus, TendonLimits
from apcc_torch.control.trajectory import SetPoint, SineTrajectory, Trajectory

__all__ = [
    "APCCController",
    "AdaptiveDynamics",
    "AdaptiveDynamicsSettings",
    "AdaptiveLaw",
    "AdaptiveLawSettings",
    "Capsule",
    "ClearanceCost",
    "Command",
    "CompositeController",
    "CompositeControllerSettings",
    "ConstrainedVelocity",
    "ControlSettings",
    "ControllerSettings",
    "ControllerState",
    "HalfSpace",
    "InverseKinematics",
    "InverseKinematicsSettings",
    "LawStep",
    "LengthBounds",
    "LengthBoundsSettings",
    "LengthLaw",
    "Lookahead",
    "LookaheadController",
    "LookaheadSettings",
    "Measurement",
    "NormalisedLaw",
    "NormalisedLawSettings",
    "Obstacle",
    "PressureControl",
    "PressureControlSettings",
    "SensorNoise",
    "SetPoint",
    "ShapeLaw",
    "ShapeLawSettings",
    "SineTrajectory",
    "SolverStatus",
    "Sphere",
    "Target",
    "Task",
    "TaskController",
    "TaskIntegral",
    "TaskIntegralSettings",
    "TaskStack",
    "TaskTarget",
    "TendonLimits",
    "TendonPID",
    "TendonPIDSettings",
    "TendonReference",
    "Trajectory",
    "elongation_cost",
    "estimate_covariance",
    "ramp",
]
