"""All motors of the bus as one: checked, set up, torqued, read and let go together, in the registers' units."""

from __future__ import annotations

import logging
from collections.abc import Mapping

from apcc_torch.errors import CommunicationError, DeviceFaultError, HardwareError
from apcc_torch.hardware.dynamixel.bus import DynamixelBus
from apcc_torch.hardware.dynamixel.registers import (
    ACCELERATION_UNIT,
    BUS_WATCHDOG,
    CURRENT_LIMIT,
    CURRENT_UNIT,
    DRIVE_MODE,
    FIRMWARE_VERSION,
    GOAL_CURRENT,
    GOAL_POSITION,
    HARDWARE_ERROR,
    INDIRECT_ADDRESS,
    INDIRECT_DATA,
    MODEL_NUMBER,
    OPERATING_MODE,
    OPERATING_MODES,
    PRESENT_POSITION,
    PROFILE_ACCELERATION,
    PROFILE_VELOCITY,
    RETURN_DELAY,
    SHUTDOWN,
    STARTUP_CONFIGURATION,
    STATUS_RETURN_LEVEL,
    TICKS_PER_TURN,
    TORQUE_ENABLE,
    VELOCITY_UNIT,
    hardware_errors,
)
from apcc_torch.hardware.dynamixel.settings import DynamixelSettings
from apcc_torch.hardware.dynamixel.status import (
    ANSWERS_EVERYTHING,
    STATUS_LENGTH,
    MotorStatus,
    indirect_addresses,
)
from apcc_torch.hardware.dynamixel.zero_mark import erase_mark

log = logging.getLogger(__name__)

# Let go on overload (bit 5), electrical shock (4) and overheating (2): the motor's own default.
SHUTDOWN_BITS = 0b11_0100
TORQUE_OFF_TRIES = 3
GOAL_SLACK = 8  # ticks that a hanging arm may move between two exchanges
LOST_TURN = TICKS_PER_TURN // 4


class Motors:
    """The motors of the settings, the gripper's last.

    Args:
        bus: Their bus.
        settings: What they must be and are set to.
    """

    def __init__(self, bus: DynamixelBus, settings: DynamixelSettings) -> None:
        self.bus = bus
        self.settings = settings
        gripper = settings.gripper
        self.ids = (*settings.ids, *((gripper.id,) if gripper else ()))
        amperes = [settings.current_limit] * len(settings.ids) + ([gripper.current_limit] if gripper else [])
        self.current_ticks = {motor: int(limit / CURRENT_UNIT) for motor, limit in zip(self.ids, amperes, strict=True)}
        self.armed = False

    def check(self) -> None:
        """Refuses motors that are not those of the settings, or not fit to run. Writes nothing but a release.

        Raises:
            CommunicationError: A motor does not answer.
            DeviceFaultError: A hardware error is latched.
            HardwareError: Wrong model, too old a firmware, or torque that nobody is known to have switched on.
        """
        for motor in self.ids:
            self.bus.ping(motor)
            self._check_one(motor)
        torqued = [motor for motor in self.ids if self.bus.read(motor, TORQUE_ENABLE)]
        if torqued and not self.settings.release_torqued:
            names = ", ".join(self.bus.name(motor) for motor in torqued)
            raise HardwareError(f"{names} holds torque already; release_torqued=true lets go, and the arm drops")
        for motor in torqued:
            log.warning("%s held torque and is let go", self.bus.name(motor))
            self.bus.write(motor, TORQUE_ENABLE, 0)

    def _check_one(self, motor: int) -> None:
        name = self.bus.name(motor)
        if (model := self.bus.read(motor, MODEL_NUMBER)) != self.settings.model_number:
            raise HardwareError(f"{name} is model {model}, not {self.settings.model_number}")
        if (firmware := self.bus.read(motor, FIRMWARE_VERSION)) < self.settings.minimum_firmware:
            raise HardwareError(f"{name} has firmware {firmware}, older than {self.settings.minimum_firmware}")
        if errors := self.bus.read(motor, HARDWARE_ERROR):
            raise DeviceFaultError(f"{name} reports {hardware_errors(errors)}: turn its power off and on")

    def configure(self) -> None:
        """Writes what every connection needs, torque being off. What is kept without power is written if it differs."""
        for motor in self.ids:
            for register, value in (
                (RETURN_DELAY, 0),
                (DRIVE_MODE, 0),
                (OPERATING_MODE, OPERATING_MODES[self.settings.mode]),
                (CURRENT_LIMIT, self.current_ticks[motor]),
                (STARTUP_CONFIGURATION, 0),
                (SHUTDOWN, SHUTDOWN_BITS),
                (STATUS_RETURN_LEVEL, ANSWERS_EVERYTHING),
            ):
                if self.bus.read(motor, register) != value:
                    self.bus.write(motor, register, value)
                    if register is OPERATING_MODE:  # a motor forgets its turns on that
                        erase_mark(self.bus, motor)
            self.bus.write(motor, BUS_WATCHDOG, 0)
            self.bus.write_bytes(motor, INDIRECT_ADDRESS, indirect_addresses())

    def status(self) -> dict[int, MotorStatus]:
        """Every motor's status block, whatever it says. Raises CommunicationError if one does not answer."""
        blocks = self.bus.sync_read(self.ids, INDIRECT_DATA, STATUS_LENGTH)
        return {motor: MotorStatus.decode(blocks[motor]) for motor in self.ids}

    def check_status(self, status: Mapping[int, MotorStatus]) -> None:
        """Raises DeviceFaultError, which names each motor with a fault and the fault."""
        faults: dict[str, list[str]] = {}
        for motor, state in status.items():
            if said := state.fault(self.armed, self.settings.watchdog_ticks):
                faults.setdefault(said, []).append(self.bus.name(motor))
        if faults:
            raise DeviceFaultError("; ".join(f"{', '.join(names)} {said}" for said, names in faults.items()))

    def arm(self, goals: Mapping[int, int]) -> None:
        """Torque on, with goals in ticks already set and read back, and the bus watchdog running.

        Raises:
            CommunicationError: A motor did not answer; all are let go.
            DeviceFaultError: A motor refuses, or does not hold what was written; all are let go.
        """
        try:
            for motor in self.ids:
                # A tripped watchdog refuses goals until it is cleared, and has dropped the profile.
                self.bus.write(motor, BUS_WATCHDOG, 0)
                self.bus.write(
                    motor, PROFILE_ACCELERATION, round(self.settings.profile_acceleration / ACCELERATION_UNIT)
                )
                self.bus.write(motor, PROFILE_VELOCITY, round(self.settings.profile_velocity / VELOCITY_UNIT))
                self.bus.write(motor, GOAL_CURRENT, self.current_ticks[motor])
                self.bus.write(motor, GOAL_POSITION, goals[motor])
            before = self._check_goals(goals)
            for motor in self.ids:
                self.bus.write(motor, BUS_WATCHDOG, self.settings.watchdog_ticks)
            for motor in self.ids:
                self.bus.write(motor, TORQUE_ENABLE, 1)
            self.armed = True
            self.write_goals(goals)
            status = self.status()
            self.check_status(status)
            for motor, state in status.items():
                if abs(state.position - before[motor]) > LOST_TURN:
                    raise DeviceFaultError(f"{self.bus.name(motor)} moved when it was armed: calibrate again")
        except BaseException:
            self.torque_off()
            raise

    def _check_goals(self, goals: Mapping[int, int]) -> dict[int, int]:
        """The positions, if no motor would turn further than to its goal; some let it follow them without torque."""
        length = PRESENT_POSITION.address + PRESENT_POSITION.length - GOAL_POSITION.address
        positions = {}
        for motor, data in self.bus.sync_read(self.ids, GOAL_POSITION.address, length).items():
            goal = GOAL_POSITION.decode(data[: GOAL_POSITION.length])
            position = PRESENT_POSITION.decode(data[-PRESENT_POSITION.length :])
            if abs(goal - position) > abs(goals[motor] - position) + GOAL_SLACK:
                raise DeviceFaultError(f"{self.bus.name(motor)} has goal {goal} instead of {goals[motor]}")
            positions[motor] = position
        return positions

    def write_goals(self, goals: Mapping[int, int]) -> None:
        """Goals in ticks, in one packet that no motor answers: a refusal shows in the next status."""
        if not goals:
            return
        self.bus.sync_write(GOAL_POSITION, goals)

    def reachable(self) -> tuple[dict[int, MotorStatus], dict[int, HardwareError]]:
        """The status blocks that can be had, and why the others cannot."""
        blocks, wrong = self.bus.sync_gather(self.ids, INDIRECT_DATA, STATUS_LENGTH)
        return {motor: MotorStatus.decode(data) for motor, data in blocks.items()}, wrong

    def torque_off(self) -> tuple[int, ...]:
        """Lets go of every motor, whatever fails on the way; returns those that did not confirm it."""
        self.armed = False
        left = list(self.ids)
        for attempt in range(TORQUE_OFF_TRIES):
            failed: dict[int, HardwareError] = {}
            try:
                self.bus.sync_write(TORQUE_ENABLE, dict.fromkeys(left, 0))
            except CommunicationError as error:
                failed = dict.fromkeys(left, error)
            for motor in left:
                try:
                    self.bus.write(motor, TORQUE_ENABLE, 0)
                except HardwareError as error:
                    failed[motor] = error
                else:
                    failed.pop(motor, None)
            left = list(failed)
            if not left:
                break
            said = "; ".join(dict.fromkeys(str(error) for error in failed.values()))
            log.error("torque off, attempt %d of %d: %s", attempt + 1, TORQUE_OFF_TRIES, said)
        return tuple(left)
