"""All Dynamixel motors of a bus as one, of whatever models: in the registers' units."""

from __future__ import annotations

import contextlib
from collections.abc import Mapping
from typing import Any

import numpy as np

from apcc_torch.errors import CommunicationError, DeviceFaultError, HardwareError
from apcc_torch.hardware.dynamixel import registers
from apcc_torch.hardware.dynamixel.bus import DynamixelBus
from apcc_torch.hardware.dynamixel.models import Model
from apcc_torch.hardware.dynamixel.settings import VELOCITY, DynamixelSettings
from apcc_torch.hardware.dynamixel.status import STATUS_LENGTH, MotorStatus, indirect_addresses
from apcc_torch.hardware.dynamixel.velocity_loop import VelocityLoop
from apcc_torch.hardware.dynamixel.wanted import Wanted, of_armed, of_connected
from apcc_torch.hardware.dynamixel.zero_mark import DIGITS, MARKS, address, encoded
from apcc_torch.hardware.interfaces import Array
from apcc_torch.hardware.servos.motors import ServoMotors, each
from apcc_torch.hardware.servos.register import Register
from apcc_torch.hardware.servos.settings import MAX_ID
from apcc_torch.plain_text import plain_logger

log = plain_logger(__name__)


class Motors(ServoMotors):
    """The motors of the settings, the gripper's last.

    Args:
        bus: Their bus.
        settings: What they must be and are set to.
    """

    torque = registers.TORQUE_ENABLE
    farthest = registers.MAX_POSITION
    marks = MARKS

    def __init__(self, bus: DynamixelBus, settings: DynamixelSettings) -> None:
        super().__init__(bus, settings.every_id, settings.release_torqued)
        self.bus: DynamixelBus = bus
        self.settings = settings
        self.models = settings.models
        self.currents = settings.currents
        self.modes = {motor: settings.mode_of(motor) for motor in self.ids}
        self.fastest = np.array([model.fastest for model in settings.tendon_models])
        constants = (model.torque_constant for model in settings.tendon_models)
        self.torque_constants = settings.told_or("torque_constant", constants)
        moved = [motor for motor in self.ids if self.modes[motor] == VELOCITY]
        self.loop = VelocityLoop(moved, settings.velocity_gain, settings.profile_velocity)

    def check(self) -> None:
        """See `ServoMotors.check`. It also takes the mark of its calibration off a motor that shifts its positions.

        Raises:
            CommunicationError: A motor does not answer.
            DeviceFaultError: A hardware error is latched.
            HardwareError: Wrong model, too old a firmware, an offset of its positions, or torque that nobody is known
                to have switched on.
        """
        for motor in self.ids:
            self.bus.ping(motor)
            self._check_one(motor, self.models[motor])
        self.refuse_torqued()
        self.refuse_offset(registers.HOMING_OFFSET, "DYNAMIXEL Wizard")
        blind = [self.bus.name(motor) for motor in self.settings.ids if self.models[motor].current_unit is None]
        if blind:
            log.warning("%s tells no current: the guards of tensions do not see its tendon", ", ".join(blind))

    def _check_one(self, motor: int, model: Model) -> None:
        name = self.bus.name(motor)
        if (found := self.bus.read(motor, registers.MODEL_NUMBER)) != model.number:
            raise HardwareError(f"{name} is model {found}, not {model.number}")
        given = self.settings.minimum_firmware
        least = model.firmware if given is None else given
        if (firmware := self.bus.read(motor, registers.FIRMWARE_VERSION)) < least:
            raise HardwareError(f"{name} has firmware {firmware}, older than {least}")
        if errors := self.bus.read(motor, registers.HARDWARE_ERROR):
            raise DeviceFaultError(f"{name} reports {registers.hardware_errors(errors)}: turn its power off and on")

    def _armed(self, motor: int) -> Wanted:
        return of_armed(self.settings, motor, self._pwm(motor))

    def _pwm(self, motor: int) -> int:
        """What a motor may take of the supply's voltage, as it is now."""
        if not self.settings.limited_by_voltage(motor):
            return registers.MAX_PWM
        voltage = registers.VOLTAGE_UNIT * self.bus.read(motor, registers.PRESENT_INPUT_VOLTAGE)
        if not voltage > 0:
            raise DeviceFaultError(f"{self.bus.name(motor)} tells no supply voltage, which its current limit needs")
        return self.models[motor].stalled_pwm(self.currents[motor], voltage)

    def configure(self) -> None:
        """See `ServoMotors.configure`.

        Raises:
            CommunicationError: A motor does not answer.
            DeviceFaultError: A motor does not take a setting; the sentence says what it has and what is needed.
        """
        needed = {motor: dict(of_connected(self.settings, motor)) for motor in self.ids}
        for register in dict.fromkeys(register for wanted in needed.values() for register in wanted):
            ids = [motor for motor in self.ids if register in needed[motor]]
            found = self.bus.sync_read(ids, register.address, register.length)
            for motor in ids:
                value = register.decode(found[motor])
                if register is registers.SECONDARY_ID and value > MAX_ID:  # all of those are none
                    continue
                # A motor forgets its turns with another mode, or counted them the other way.
                if self.set(motor, register, value, needed[motor][register]) and register in (
                    registers.OPERATING_MODE,
                    registers.DRIVE_MODE,
                ):
                    self.erase_mark(motor)
        for motor in self.ids:
            self.bus.write(motor, registers.BUS_WATCHDOG, 0)
            self.bus.write_bytes(motor, registers.INDIRECT_ADDRESS, indirect_addresses())

    def _mark(self, motor: int, mark: int | None) -> None:
        model = self.models[motor]
        self.bus.write_bytes(motor, address(model), encoded(model, mark))

    def _bears(self, motor: int, mark: int) -> bool:
        model = self.models[motor]
        return self.bus.read_bytes(motor, address(model), 2 * DIGITS) == encoded(model, mark)

    def reachable(self) -> tuple[dict[int, MotorStatus], dict[int, HardwareError]]:
        """See `ServoMotors.reachable`: one sync read of those whose tables are alike."""
        blocks: dict[int, bytes] = {}
        wrong: dict[int, HardwareError] = {}
        for begin in dict.fromkeys(model.indirect_data for model in self.models.values()):
            ids = [motor for motor in self.ids if self.models[motor].indirect_data == begin]
            answers, missing = self.bus.sync_gather(ids, begin, STATUS_LENGTH)
            blocks |= answers
            wrong |= missing
        status = {motor: MotorStatus.decode(blocks[motor]) for motor in self.ids if motor in blocks}
        self.loop.see({motor: state.position for motor, state in status.items()})
        return status, wrong

    def status(self) -> Mapping[int, MotorStatus]:
        """See `ServoMotors.status`. Motors that are told velocities stand still after a reading that failed."""
        try:
            status = super().status()
        except HardwareError:
            if self.armed and self.loop.motors:
                self.loop.see({})
                with contextlib.suppress(CommunicationError):  # the one that is under way says why
                    self._write_velocities()
            raise
        if self.armed and self.loop.holding:
            self._write_velocities()
        return status

    def _fault(self, motor: int, state: MotorStatus) -> str:
        return state.fault(self.armed, self.settings.watchdog_ticks)

    def speeds(self, status: Mapping[int, Any], ids: tuple[int, ...]) -> Array:
        """See `ServoMotors.speeds`."""
        return registers.VELOCITY_UNIT * each(status, ids, lambda state: state.velocity)

    def torques(self, status: Mapping[int, Any], ids: tuple[int, ...]) -> Array:
        """See `ServoMotors.torques`: the current times the torque constant."""
        units = [self.torque_constants[motor] * (self.models[motor].current_unit or 0.0) for motor in ids]
        return np.array(units) * each(status, ids, lambda state: state.current)

    def _prepare(self, goals: Mapping[int, int]) -> dict[int, int]:
        """The bus watchdog runs from then on."""
        wanted = {}
        for motor in self.ids:
            # A tripped watchdog refuses goals until it is cleared.
            self.bus.write(motor, registers.BUS_WATCHDOG, 0)
            wanted[motor] = self._armed(motor)
            goal = [] if motor in self.loop.motors else [(registers.GOAL_POSITION, goals[motor])]
            for register, value in (*wanted[motor], *goal):
                self.bus.write(motor, register, value)
        before = self._check_goals(goals, wanted)
        for motor in self.ids:
            self.bus.write(motor, registers.BUS_WATCHDOG, self.settings.watchdog_ticks)
        return before

    def _check_goals(self, goals: Mapping[int, int], wanted: Mapping[int, Wanted]) -> dict[int, int]:
        """The positions, if every limit is as written and no motor would turn further than to its goal."""
        first = registers.GOAL_PWM.address
        length = registers.PRESENT_POSITION.address + registers.PRESENT_POSITION.length - first
        positions = {}
        for motor, data in self.bus.sync_read(self.ids, first, length).items():

            def held(register: Register, data: bytes = data) -> int:
                return register.decode(data[register.address - first :][: register.length])

            for register, needed in wanted[motor]:
                if (found := held(register)) != needed:
                    raise DeviceFaultError(self._wrong(motor, register, found, needed))
            positions[motor] = held(registers.PRESENT_POSITION)
            if motor not in self.loop.motors:
                self.check_goal(motor, held(registers.GOAL_POSITION), positions[motor], goals[motor])
        return positions

    def write_goals(self, goals: Mapping[int, int], hold: bool = False) -> None:
        """See `ServoMotors.write_goals`. Motors that are told velocities get those that lead to their goals."""
        self.loop.holding = hold
        direct = {motor: goal for motor, goal in goals.items() if motor not in self.loop.motors}
        if direct:
            self.bus.sync_write(registers.GOAL_POSITION, direct)
        if self.loop.motors:
            if hold:  # motors that are left out stand where they are
                self.loop.goals.clear()
            self.loop.goals.update({motor: goal for motor, goal in goals.items() if motor in self.loop.motors})
            self._write_velocities()

    def _write_velocities(self) -> None:
        self.bus.sync_write(registers.GOAL_VELOCITY, self.loop.take())

    def torque_off(self) -> tuple[int, ...]:
        """See `ServoMotors.torque_off`."""
        self.loop.reset()
        return super().torque_off()
