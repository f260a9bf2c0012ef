"""Tendons on Dynamixel motors of the X series."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from apcc_torch.hardware.dynamixel.bus import DynamixelBus
from apcc_torch.hardware.dynamixel.gripper import Gripper
from apcc_torch.hardware.dynamixel.motors import Motors
from apcc_torch.hardware.dynamixel.settings import DynamixelSettings
from apcc_torch.hardware.interfaces import check_library
from apcc_torch.hardware.servos.actuator import ServoActuator
from apcc_torch.hardware.servos.port import BusPort


class DynamixelActuator(ServoActuator):
    """The tendons' motors, of one model or of several, and a gripper if there is one.

    After `arm` the motors' own watchdog runs: without a `read`, `send` or `hold` in `bus_watchdog` seconds they stop
    where they are, keep their torque, and refuse goals until they are let go and armed again.

    In mode velocity the motors are told velocities, and the way to the goals is this driver's, see `VelocityLoop`: each
    `send` needs a `read` before it, and a hold lives by the readings that follow it. Where one fails the motors stand.
    """

    settings_type = DynamixelSettings
    settings: DynamixelSettings
    motors: Motors

    def __init__(self, settings: DynamixelSettings) -> None:
        check_library("dynamixel_sdk", type(self).__name__)
        names = {motor: f"motor {k + 1}" for k, motor in enumerate(settings.ids)}
        if settings.gripper:
            names[settings.gripper.id] = "gripper"
        bus = DynamixelBus(BusPort(settings.port, settings.baud, settings.reply_timeout), names)
        super().__init__(settings, Motors(bus, settings))
        self.gripper = Gripper(self.motors, settings.gripper) if settings.gripper else None

    def _other_goals(self, status: Mapping[int, Any]) -> dict[int, int]:
        if self.gripper is None:
            return {}
        motor = self.gripper.settings.id
        return {motor: self.gripper.arming_goal(status[motor].position)}
