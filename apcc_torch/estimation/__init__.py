"""From sensors to what they tell: configuration, velocity, loads, and which readings to trust."""

from __future__ import annotations

from apcc_torch.estimation.arc_fit import ArcFit, ArcFitSettings
from apcc_torch.estimation.best_fit import best_fit
from apcc_torch.estimation.contact import ContactSearch
from apcc_torch.estimation.external_force import BalanceNoise, ForceBalance, tare
from apcc_torch.estimation.feedback import Feedback, FeedbackStatus
from apcc_torch.estimation.feedback_covariance import feedback_covariance
from apcc_torch.estimation.length_covariance import length_covariance
from apcc_torch.estimation.load_from_shape import LoadFromShape, ShapeNoise
from apcc_torch.estimation.loaded_shape import LoadedShape
from apcc_torch.estimation.loaded_shape_settings import LoadedShapeSettings
from apcc_torch.estimation.momentum_observer import MomentumObserver
from apcc_torch.estimation.pose_filter import PoseFilter, PoseFilterSettings
from apcc_torch.estimation.posture import Posture, TendonMechanics
from apcc_torch.estimation.rest_calibration import RestCalibration
from apcc_torch.estimation.savitzky_golay import SavitzkyGolay, SavitzkyGolaySettings
from apcc_torch.estimation.sensor_gate import Reason, SensorGate, SensorGateSettings, gate_recording
from apcc_torch.estimation.shape_feedback import ShapeFeedback, ShapeFeedbackSettings
from apcc_torch.estimation.soft_window import SoftWindow
from apcc_torch.estimation.state_feedback import StateFeedback
from apcc_torch.estimation.state_feedback_settings import StateFeedbackSettings
from apcc_torch.estimation.weighted_estimate import EstimateStatus, weighted_estimate

__all__ = [
    "ArcFit",
    "ArcFitSettings",
    "BalanceNoise",
    "ContactSearch",
    "EstimateStatus",
    "Feedback",
    "FeedbackStatus",
    "ForceBalance",
    "LoadFromShape",
    "LoadedShape",
    "LoadedShapeSettings",
    "MomentumObserver",
    "PoseFilter",
    "PoseFilterSettings",
    "Posture",
    "Reason",
    "RestCalibration",
    "SavitzkyGolay",
    "SavitzkyGolaySettings",
    "SensorGate",
    "SensorGateSettings",
    "ShapeFeedback",
    "ShapeFeedbackSettings",
    "ShapeNoise",
    "SoftWindow",
    "StateFeedback",
    "StateFeedbackSettings",
    "TendonMechanics",
    "best_fit",
    "feedback_covariance",
    "gate_recording",
    "length_covariance",
    "tare",
    "weighted_estimate",
]
