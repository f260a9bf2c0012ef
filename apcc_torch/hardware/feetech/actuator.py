"""Tendons on Feetech STS servos."""

from __future__ import annotations

from apcc_torch.hardware.feetech.bus import FeetechBus
from apcc_torch.hardware.feetech.motors import StsMotors
from apcc_torch.hardware.feetech.settings import FeetechSettings
from apcc_torch.hardware.interfaces import check_library
from apcc_torch.hardware.servos.actuator import ServoActuator
from apcc_torch.hardware.servos.port import BusPort


class FeetechActuator(ServoActuator):
    """The tendons' servos.

    STS servos have no watchdog: where the program dies they go to their last goal, which is within the tendons' limits,
    and hold it with torque.
    """

    settings_type = FeetechSettings
    settings: FeetechSettings
    motors: StsMotors

    def __init__(self, settings: FeetechSettings) -> None:
        check_library("scservo_sdk", type(self).__name__, extra="feetech")
        names = {motor: f"motor {k + 1}" for k, motor in enumerate(settings.ids)}
        bus = FeetechBus(BusPort(settings.port, settings.baud, settings.reply_timeout), names)
        super().__init__(settings, StsMotors(bus, settings))
