"""All STS servos of a bus as one, in the registers' units."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from apcc_torch.errors import DeviceFaultError, HardwareError
from apcc_torch.hardware.feetech import registers
from apcc_torch.hardware.feetech.bus import FeetechBus
from apcc_torch.hardware.feetech.marks import BLANK, MARKS, part
from apcc_torch.hardware.feetech.settings import FeetechSettings
from apcc_torch.hardware.feetech.status import STATUS_ADDRESS, STATUS_LENGTH, StsStatus
from apcc_torch.hardware.interfaces import Array
from apcc_torch.hardware.servos.motors import ServoMotors, each
from apcc_torch.hardware.servos.register import Register

COUNTING = (
    registers.OPERATING_MODE,
    registers.MIN_ANGLE,
    registers.MAX_ANGLE,
    registers.PHASE,
    registers.ANGLE_RESOLUTION,
)  # with others a position means another thing


class StsMotors(ServoMotors):
    """The servos of the settings.

    Args:
        bus: Their bus.
        settings: What they must be and are set to.
    """

    torque = registers.TORQUE_SWITCH
    farthest = registers.FARTHEST
    marks = MARKS

    def __init__(self, bus: FeetechBus, settings: FeetechSettings) -> None:
        super().__init__(bus, settings.ids, settings.release_torqued)
        self.settings = settings
        self.models = settings.models
        self.fastest = np.array([model.fastest for model in self.models.values()])
        constants = (model.torque for model in self.models.values())
        self.torque_constants = settings.told_or("torque_constant", constants)
        self.torque_limits = {
            motor: int(limit / registers.TORQUE_UNIT)
            for motor, limit in zip(self.ids, settings.each("torque_limit"), strict=True)
        }
        self.speed_units = dict.fromkeys(self.ids, registers.SPEED_UNITS[0])  # rad/s; the phase of each tells

    def check(self) -> None:
        """See `ServoMotors.check`. It also takes the mark of its calibration off a servo that shifts its positions.

        Raises:
            CommunicationError: A servo does not answer.
            DeviceFaultError: A servo reports a fault.
            HardwareError: Wrong model, an offset of its positions, or torque that nobody is known to have switched on.
        """
        for motor in self.ids:
            name = self.bus.name(motor)
            self.bus.ping(motor)
            if (found := self.bus.read(motor, registers.MODEL_NUMBER)) != self.models[motor].number:
                raise HardwareError(f"{name} is model {found}, not {self.models[motor].number}")
            if errors := self.bus.read(motor, registers.STATUS):
                raise DeviceFaultError(f"{name} reports {registers.status_names(errors)}: turn its power off and on")
        self.refuse_torqued()
        self.refuse_offset(registers.POSITION_OFFSET, "Feetech's own tool")

    def _connected(self, motor: int) -> list[tuple[Register, int]]:
        """What scales, shifts or limits a servo's motion and is kept without power, in the order of writing."""
        wanted = [
            (registers.OPERATING_MODE, registers.POSITION_MODE),
            (registers.MIN_ANGLE, 0),  # both zero: goals of several turns
            (registers.MAX_ANGLE, 0),
            (registers.ANGLE_RESOLUTION, 1),
            (registers.PHASE, self.bus.read(motor, registers.PHASE) | registers.FULL_ANGLE),
            (registers.UNLOAD, self.bus.read(motor, registers.UNLOAD) | registers.PROTECTIONS),
        ]
        if self.settings.position_gains is not None:
            P, I, D = self.settings.position_gains  # noqa: E741 - as they are called
            wanted += [(registers.POSITION_P_GAIN, P), (registers.POSITION_I_GAIN, I), (registers.POSITION_D_GAIN, D)]
        return wanted

    def configure(self) -> None:
        """See `ServoMotors.configure`.

        Raises:
            CommunicationError: A servo does not answer.
            DeviceFaultError: A servo does not take a setting; the sentence says what it has and what is needed.
        """
        for motor in self.ids:
            self._let_it_answer(motor)
            different = [
                (register, found, needed)
                for register, needed in self._connected(motor)
                if (found := self.bus.read(motor, register)) != needed
            ]
            if different:
                self.bus.write(motor, registers.LOCK, registers.OPEN)
                try:
                    for register, found, needed in different:
                        self.set(motor, register, found, needed)
                        if register in COUNTING:
                            self.erase_mark(motor)
                finally:
                    self.bus.write(motor, registers.LOCK, registers.CLOSED)
            self.speed_units[motor] = registers.SPEED_UNITS[
                bool(self.bus.read(motor, registers.PHASE) & registers.FINE_SPEED)
            ]
            if self.bus.read(motor, registers.PWM_SPEED) == registers.PWM_SPEED_AT_START:
                self.erase_mark(motor)

    def _let_it_answer(self, motor: int) -> None:
        """A servo that answers readings alone would seem to be gone at the first write."""
        if self.bus.read(motor, registers.RESPONSE_LEVEL) == 1:
            return
        for register, value in (
            (registers.LOCK, registers.OPEN),
            (registers.RESPONSE_LEVEL, 1),
            (registers.LOCK, registers.CLOSED),
        ):
            self.bus.sync_write(register, {motor: value})
        if (kept := self.bus.read(motor, registers.RESPONSE_LEVEL)) != 1:
            raise DeviceFaultError(f"{self._wrong(motor, registers.RESPONSE_LEVEL, kept, 1)}, and does not take it")

    def _mark(self, motor: int, mark: int | None) -> None:
        self.bus.write(motor, registers.PWM_SPEED, BLANK if mark is None else part(mark, self.ids.index(motor)))

    def _bears(self, motor: int, mark: int) -> bool:
        return self.bus.read(motor, registers.PWM_SPEED) == part(mark, self.ids.index(motor))

    def reachable(self) -> tuple[dict[int, StsStatus], dict[int, HardwareError]]:
        """See `ServoMotors.reachable`."""
        blocks, wrong = self.bus.sync_gather(self.ids, STATUS_ADDRESS, STATUS_LENGTH)
        return {motor: StsStatus.decode(data) for motor, data in blocks.items()}, wrong

    def _fault(self, motor: int, state: StsStatus) -> str:
        return state.fault(self.armed, self.torque_limits[motor])

    def speeds(self, status: Mapping[int, Any], ids: tuple[int, ...]) -> Array:
        """See `ServoMotors.speeds`."""
        return np.array([self.speed_units[motor] * status[motor].speed for motor in ids])

    def torques(self, status: Mapping[int, Any], ids: tuple[int, ...]) -> Array:
        """See `ServoMotors.torques`: the current times the torque constant, in the direction of the voltage.

        The sign of the current is not the same in all firmware.
        """
        constants = np.array([self.torque_constants[motor] for motor in ids])
        currents = registers.CURRENT_UNIT * each(status, ids, lambda state: abs(state.current))
        return np.sign(each(status, ids, lambda state: state.load)) * constants * currents

    def _armed(self, motor: int) -> list[tuple[Register, int]]:
        """What limits the motion and does not outlive a restart."""
        return [
            (registers.TORQUE_LIMIT, self.torque_limits[motor]),
            (registers.ACCELERATION, int(self.settings.profile_acceleration / registers.ACCELERATION_UNIT)),
            (registers.RUNNING_SPEED, int(self.settings.profile_velocity / self.speed_units[motor])),
        ]

    def _prepare(self, goals: Mapping[int, int]) -> dict[int, int]:
        """A goal alone may switch the torque of some on: it is that of the present position."""
        for motor in self.ids:
            for register, value in (*self._armed(motor), (registers.GOAL_POSITION, goals[motor])):
                self.bus.write(motor, register, value)
        status = self.status()
        for motor, state in status.items():
            held = (state.torque_limit, state.acceleration, state.running_speed)
            for (register, needed), found in zip(self._armed(motor), held, strict=True):
                if found != needed:
                    raise DeviceFaultError(self._wrong(motor, register, found, needed))
            self.check_goal(motor, state.goal, state.position, goals[motor])
        return {motor: state.position for motor, state in status.items()}

    def write_goals(self, goals: Mapping[int, int], hold: bool = False) -> None:
        """See `ServoMotors.write_goals`."""
        if goals:
            self.bus.sync_write(registers.GOAL_POSITION, goals)
