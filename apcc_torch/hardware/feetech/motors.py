"""All STS servos of a bus as one, in the registers' units."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from apcc_torch.errors import DeviceFaultError, HardwareError
from apcc_torch.hardware.feetech.bus import FeetechBus
from apcc_torch.hardware.feetech.marks import BLANK, new_mark, parts
from apcc_torch.hardware.feetech.registers import (
    ACCELERATION,
    ACCELERATION_UNIT,
    ANGLE_RESOLUTION,
    CLOSED,
    CURRENT_UNIT,
    FARTHEST,
    FINE_SPEED,
    FULL_ANGLE,
    GOAL_POSITION,
    LOCK,
    MAX_ANGLE,
    MIN_ANGLE,
    MODEL_NUMBER,
    ON,
    OPEN,
    OPERATING_MODE,
    PHASE,
    POSITION_D_GAIN,
    POSITION_I_GAIN,
    POSITION_MODE,
    POSITION_OFFSET,
    POSITION_P_GAIN,
    PROTECTIONS,
    PWM_SPEED,
    PWM_SPEED_AT_START,
    RESPONSE_LEVEL,
    RUNNING_SPEED,
    SPEED_UNITS,
    STATUS,
    TORQUE_LIMIT,
    TORQUE_SWITCH,
    TORQUE_UNIT,
    UNLOAD,
    status_names,
)
from apcc_torch.hardware.feetech.settings import FeetechSettings
from apcc_torch.hardware.feetech.status import STATUS_ADDRESS, STATUS_LENGTH, StsStatus
from apcc_torch.hardware.interfaces import Array
from apcc_torch.hardware.servos.bus import raise_all
from apcc_torch.hardware.servos.motors import ServoMotors, each
from apcc_torch.hardware.servos.register import Register
from apcc_torch.hardware.servos.spool import TICKS_PER_TURN

LOST_TURN = TICKS_PER_TURN // 4
COUNTING = (OPERATING_MODE, MIN_ANGLE, MAX_ANGLE, PHASE, ANGLE_RESOLUTION)  # with others a position means another thing


class StsMotors(ServoMotors):
    """The servos of the settings.

    Args:
        bus: Their bus.
        settings: What they must be and are set to.
    """

    torque = TORQUE_SWITCH
    farthest = FARTHEST

    def __init__(self, bus: FeetechBus, settings: FeetechSettings) -> None:
        super().__init__(bus, settings.ids, settings.release_torqued)
        self.settings = settings
        self.models = settings.models
        self.fastest = np.array([model.fastest for model in self.models.values()])
        given = settings.torque_constant
        constants = [model.torque for model in self.models.values()]
        self.torque_constants = dict(
            zip(self.ids, constants if given is None else settings.each("torque_constant"), strict=True)
        )
        self.torque_limits = {
            motor: int(limit / TORQUE_UNIT)
            for motor, limit in zip(self.ids, settings.each("torque_limit"), strict=True)
        }
        self.speed_units = dict.fromkeys(self.ids, SPEED_UNITS[0])  # rad/s; the phase of each tells

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
            if (found := self.bus.read(motor, MODEL_NUMBER)) != self.models[motor].number:
                raise HardwareError(f"{name} is model {found}, not {self.models[motor].number}")
            if errors := self.bus.read(motor, STATUS):
                raise DeviceFaultError(f"{name} reports {status_names(errors)}: turn its power off and on")
        self.refuse_torqued()
        self.refuse_offset(POSITION_OFFSET, "Feetech's own tool")

    def _connected(self, motor: int) -> list[tuple[Register, int]]:
        """What scales, shifts or limits a servo's motion and is kept without power, in the order of writing."""
        wanted = [
            (OPERATING_MODE, POSITION_MODE),
            (MIN_ANGLE, 0),  # both zero: goals of several turns
            (MAX_ANGLE, 0),
            (ANGLE_RESOLUTION, 1),
            (PHASE, self.bus.read(motor, PHASE) | FULL_ANGLE),
            (UNLOAD, self.bus.read(motor, UNLOAD) | PROTECTIONS),
        ]
        if self.settings.position_gains is not None:
            P, I, D = self.settings.position_gains  # noqa: E741 - as they are called
            wanted += [(POSITION_P_GAIN, P), (POSITION_I_GAIN, I), (POSITION_D_GAIN, D)]
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
                self.bus.write(motor, LOCK, OPEN)
                try:
                    for register, found, needed in different:
                        self.set(motor, register, found, needed)
                        if register in COUNTING:
                            self.erase_mark(motor)
                finally:
                    self.bus.write(motor, LOCK, CLOSED)
            self.speed_units[motor] = SPEED_UNITS[bool(self.bus.read(motor, PHASE) & FINE_SPEED)]
            if self.bus.read(motor, PWM_SPEED) == PWM_SPEED_AT_START:
                self.erase_mark(motor)

    def _let_it_answer(self, motor: int) -> None:
        """A servo that answers readings alone would seem to be gone at the first write."""
        if self.bus.read(motor, RESPONSE_LEVEL) == 1:
            return
        for register, value in ((LOCK, OPEN), (RESPONSE_LEVEL, 1), (LOCK, CLOSED)):
            self.bus.sync_write(register, {motor: value})
        if (kept := self.bus.read(motor, RESPONSE_LEVEL)) != 1:
            raise DeviceFaultError(f"{self._wrong(motor, RESPONSE_LEVEL, kept, 1)}, and does not take it")

    def leave_mark(self) -> int:
        """See `ServoMotors.leave_mark`."""
        mark = new_mark()
        for motor, part in parts(mark, self.ids).items():
            self.bus.write(motor, PWM_SPEED, part)
        return mark

    def check_mark(self, mark: int) -> None:
        """See `ServoMotors.check_mark`."""
        lost = [motor for motor, part in parts(mark, self.ids).items() if self.bus.read(motor, PWM_SPEED) != part]
        if lost:
            names = ", ".join(self.bus.name(motor) for motor in lost)
            raise HardwareError(f"{names} lost power since that calibration, or has a newer one: calibrate again")

    def erase_mark(self, motor: int) -> None:
        """See `ServoMotors.erase_mark`."""
        self.bus.write(motor, PWM_SPEED, BLANK)

    def reachable(self) -> tuple[dict[int, StsStatus], dict[int, HardwareError]]:
        """See `ServoMotors.reachable`."""
        blocks, wrong = self.bus.sync_gather(self.ids, STATUS_ADDRESS, STATUS_LENGTH)
        return {motor: StsStatus.decode(data) for motor, data in blocks.items()}, wrong

    def status(self) -> dict[int, StsStatus]:
        """See `ServoMotors.status`."""
        status, wrong = self.reachable()
        raise_all(wrong.values())
        return status

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
        currents = CURRENT_UNIT * each(status, ids, lambda state: abs(state.current))
        return np.sign(each(status, ids, lambda state: state.load)) * constants * currents

    def _armed(self, motor: int) -> list[tuple[Register, int]]:
        """What limits the motion and does not outlive a restart."""
        return [
            (TORQUE_LIMIT, self.torque_limits[motor]),
            (ACCELERATION, int(self.settings.profile_acceleration / ACCELERATION_UNIT)),
            (RUNNING_SPEED, int(self.settings.profile_velocity / self.speed_units[motor])),
        ]

    def arm(self, goals: Mapping[int, int]) -> None:
        """See `ServoMotors.arm`.

        A goal alone may switch the torque of some on: it is that of the present position.

        Raises:
            CommunicationError: A servo did not answer; all are let go.
            DeviceFaultError: A servo does not hold what was written; all are let go.
        """
        try:
            for motor in self.ids:
                for register, value in (*self._armed(motor), (GOAL_POSITION, goals[motor])):
                    self.bus.write(motor, register, value)
            before = self.status()
            for motor, state in before.items():
                held = (state.torque_limit, state.acceleration, state.running_speed)
                for (register, needed), found in zip(self._armed(motor), held, strict=True):
                    if found != needed:
                        raise DeviceFaultError(self._wrong(motor, register, found, needed))
                self.check_goal(motor, state.goal, state.position, goals[motor])
            for motor in self.ids:
                self.bus.write(motor, TORQUE_SWITCH, ON)
            self.armed = True
            self.write_goals(goals)
            after = self.status()
            self.check_status(after)
            self.check_still({motor: state.position for motor, state in before.items()}, after, LOST_TURN)
        except BaseException:
            self.torque_off()
            raise

    def write_goals(self, goals: Mapping[int, int], hold: bool = False) -> None:
        """See `ServoMotors.write_goals`."""
        if goals:
            self.bus.sync_write(GOAL_POSITION, goals)
