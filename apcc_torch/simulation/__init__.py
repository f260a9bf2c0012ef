"""True arms, their sensors, closed loops, and how well a controller did in them."""

from __future__ import annotations

from apcc_torch.simulation.dynamic import DynamicSettings, simulate_dynamic
from apcc_torch.simulation.exact import simulate_exact
from apcc_torch.simulation.kinematic import simulate_feedback, start_configuration
from apcc_torch.simulation.metrics import backbone_error, mapping_error, orientation_error, shape_error
from apcc_torch.simulation.plant import Plant, PlantSettings
from apcc_torch.simulation.sensors import PoseSensors, PoseSensorsSettings

__all__ = [
    "DynamicSettings",
    "Plant",
    "PlantSettings",
    "PoseSensors",
    "PoseSensorsSettings",
    "backbone_error",
    "mapping_error",
    "orientation_error",
    "shape_error",
    "simulate_dynamic",
    "simulate_exact",
    "simulate_feedback",
    "start_configuration",
]
