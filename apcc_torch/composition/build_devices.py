"""Settings of the real devices to their drivers."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import fields
from typing import Any, NamedTuple, TypeVar

from apcc_torch.composition.hardware import DynamixelConfig, OptiTrackConfig
from apcc_torch.composition.realtime import RealtimeConfig
from apcc_torch.errors import ApccError, ConfigError
from apcc_torch.hardware.clock import Clock, MonotonicClock
from apcc_torch.hardware.drivers import dynamixel_actuator, optitrack_sensor
from apcc_torch.hardware.dynamixel.settings import DynamixelSettings, GripperSettings
from apcc_torch.hardware.interfaces import PoseSensor, TendonActuator
from apcc_torch.hardware.optitrack.settings import OptiTrackSettings

PER_TENDON = ("spool_radii", "signs", "lower", "upper")

Settings = TypeVar("Settings")


class Devices(NamedTuple):
    """Motors and cameras, the clock of their stamps, and what they add to a run's metrics once it is over."""

    actuator: TendonActuator
    sensor: PoseSensor
    clock: Clock
    metrics: Callable[[], dict[str, float]] = dict


def real_devices(config: RealtimeConfig) -> Devices:
    """The drivers of the paper's platform, not yet connected.

    Raises:
        ConfigError: A setting has no meaning, or a driver's library is not installed.
    """
    dynamixel, optitrack = config.hardware.dynamixel, config.hardware.optitrack
    if dynamixel is None or optitrack is None:
        raise ConfigError("hardware.dynamixel and hardware.optitrack must be given; see hardware=dynamixel_optitrack")
    actuator = dynamixel_actuator(dynamixel_settings(dynamixel))
    sensor = optitrack_sensor(optitrack_settings(optitrack))
    return Devices(actuator, sensor, MonotonicClock(config.loop.spin))


def dynamixel_settings(config: DynamixelConfig) -> DynamixelSettings:
    """The motors' settings; a number that stands for all tendons becomes a list."""
    values = _values(config)
    for name in PER_TENDON:
        if not isinstance(values[name], list):
            values[name] = [values[name]] * len(config.ids)
    gripper = None if config.gripper.id is None else _values(config.gripper)
    values["gripper"] = None if gripper is None else _made(GripperSettings, "dynamixel", gripper)
    return _made(DynamixelSettings, "dynamixel", values)


def optitrack_settings(config: OptiTrackConfig) -> OptiTrackSettings:
    """The motion capture's settings."""
    return _made(OptiTrackSettings, "optitrack", _values(config))


def _values(config: Any) -> dict[str, Any]:
    return {field.name: getattr(config, field.name) for field in fields(config)}


def _made(kind: Callable[..., Settings], name: str, values: dict[str, Any]) -> Settings:
    """The settings, a refusal with the name of the group before the key that it names."""
    try:
        return kind(**values)
    except (ApccError, TypeError) as error:
        raise ConfigError(f"hardware.{name}: {error}") from error
