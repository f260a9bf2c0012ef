"""Which devices a run has: motors, cameras and the world that they share, each chosen by its class."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

from apcc_torch.hardware.interfaces import PoseSensor, TendonActuator
from apcc_torch.hardware.simulated.actuator import SimulatedActuatorSettings
from apcc_torch.hardware.simulated.arm import SimulatedArm
from apcc_torch.hardware.simulated.process import ProcessSettings
from apcc_torch.hardware.simulated.sensor import SimulatedSensorSettings
from apcc_torch.hardware.world import World
from apcc_torch.part import part_of
from apcc_torch.settings import Settings, setting


@dataclass(frozen=True, kw_only=True)
class HardwareSettings(Settings):
    """A class each, with that class's own settings. A lab's own driver is named here, and nowhere else."""

    world: Settings = setting(factory=ProcessSettings, meaning="what the devices share", base=World)
    actuator: Settings = setting(factory=SimulatedActuatorSettings, meaning="motors", base=TendonActuator)
    sensor: Settings = setting(factory=SimulatedSensorSettings, meaning="source of poses", base=PoseSensor)


class Devices(NamedTuple):
    """Motors and cameras, not yet connected, and their world, which has the clock of their stamps."""

    actuator: TendonActuator
    sensor: PoseSensor
    world: World


def devices(settings: HardwareSettings, arm: Callable[[float], SimulatedArm]) -> Devices:
    """The devices that settings name.

    Args:
        settings: Their classes and settings.
        arm: Makes the simulated arm that is stepped by so many s.

    Raises:
        ConfigError: A driver's library is not installed, or a simulated device has no simulated arm.
    """
    world = part_of(settings.world).around(settings.world, arm)
    actuator, sensor = (part_of(each).in_world(each, world) for each in (settings.actuator, settings.sensor))
    return Devices(actuator, sensor, world)
