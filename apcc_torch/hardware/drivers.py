"""The real devices' drivers, loaded when a run asks for them and not before: their libraries are an extra.

This is the one place that imports by name, so that a simulated arm needs neither dynamixel-sdk nor natnet.
"""

from __future__ import annotations

import importlib
from typing import Any

from apcc_torch.errors import ConfigError
from apcc_torch.hardware.dynamixel.settings import DynamixelSettings
from apcc_torch.hardware.interfaces import PoseSensor, TendonActuator
from apcc_torch.hardware.optitrack.settings import OptiTrackSettings


def _driver(module: str, name: str) -> Any:
    """The class `name` of `module`.

    Raises:
        ConfigError: A library that it needs is not installed.
    """
    try:
        return getattr(importlib.import_module(module), name)
    except ModuleNotFoundError as error:
        missing = (error.name or "").partition(".")[0]
        if missing == __name__.partition(".")[0]:
            raise
        raise ConfigError(f"{name} needs {missing}: pip install 'apcc-torch[hardware]'") from error


def dynamixel_actuator(settings: DynamixelSettings) -> TendonActuator:
    """The Dynamixel motors, not yet connected.

    Raises:
        ConfigError: dynamixel-sdk is not installed.
    """
    actuator: TendonActuator = _driver("apcc_torch.hardware.dynamixel.actuator", "DynamixelActuator")(settings)
    return actuator


def optitrack_sensor(settings: OptiTrackSettings) -> PoseSensor:
    """The OptiTrack motion capture, not yet connected.

    Raises:
        ConfigError: natnet is not installed.
    """
    sensor: PoseSensor = _driver("apcc_torch.hardware.optitrack.sensor", "OptiTrackSensor")(settings)
    return sensor
