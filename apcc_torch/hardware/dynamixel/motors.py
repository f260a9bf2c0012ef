"""All motors of the bus as one: checked, set up, torqued, read and let go together, in the registers' units."""

from __future__ import annotations

from collections.abc import Mapping

from apcc_torch.errors import CommunicationError, DeviceFaultError, HardwareError
from apcc_torch.hardware.dynamixel.bus import DynamixelBus
from apcc_torch.hardware.dynamixel.registers import (
    ACCELERATION_UNIT,
    BUS_WATCHDOG,
    CURRENT_LIMIT,
    CURRENT_UNIT,
    DRIVE_MODE,
    FEEDFORWARD_1ST_GAIN,
    FEEDFORWARD_2ND_GAIN,
    FIRMWARE_VERSION,
    GOAL_CURRENT,
    GOAL_POSITION,
    GOAL_PWM,
    HARDWARE_ERROR,
    HOMING_OFFSET,
    INDIRECT_ADDRESS,
    INDIRECT_DATA,
    MAX_POSITION_LIMIT,
    MAX_PWM,
    MAX_VELOCITY_LIMIT,
    MIN_POSITION_LIMIT,
    MODEL_NUMBER,
    NO_SECONDARY_ID,
    OPERATING_MODE,
    OPERATING_MODES,
    POSITION_D_GAIN,
    POSITION_I_GAIN,
    POSITION_P_GAIN,
    PRESENT_POSITION,
    PROFILE_ACCELERATION,
    PROFILE_VELOCITY,
    PWM_LIMIT,
    RETURN_DELAY,
    SECONDARY_ID,
    SHUTDOWN,
    STARTUP_CONFIGURATION,
    STATUS_RETURN_LEVEL,
    TICKS_PER_TURN,
    TORQUE_ENABLE,
    VELOCITY_LIMIT,
    VELOCITY_UNIT,
    Register,
    hardware_errors,
)
from apcc_torch.hardware.dynamixel.settings import MAX_ID, DynamixelSettings
from apcc_torch.hardware.dynamixel.status import (
    ANSWERS_EVERYTHING,
    STATUS_LENGTH,
    MotorStatus,
    indirect_addresses,
)
from apcc_torch.hardware.dynamixel.zero_mark import erase_mark
from apcc_torch.plain_text import plain_logger

log = plain_logger(__name__)

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
        """Refuses motors that are not those of the settings, or not fit to run.

        It writes nothing but a release, and takes the mark of its calibration off a motor that shifts its positions.

        Raises:
            CommunicationError: A motor does not answer.
            DeviceFaultError: A hardware error is latched.
            HardwareError: Wrong model, too old a firmware, an offset of its positions, or torque that nobody is known
                to have switched on.
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
        for motor in self.ids:
            if offset := self.bus.read(motor, HOMING_OFFSET):
                # Not written here: whoever set it has to know that lengths from before mean something else.
                erase_mark(self.bus, motor)
                wrong = self._wrong(motor, HOMING_OFFSET, offset, 0)
                raise HardwareError(f"{wrong}: set it with DYNAMIXEL Wizard and calibrate again")

    def _check_one(self, motor: int) -> None:
        name = self.bus.name(motor)
        if (model := self.bus.read(motor, MODEL_NUMBER)) != self.settings.model_number:
            raise HardwareError(f"{name} is model {model}, not {self.settings.model_number}")
        if (firmware := self.bus.read(motor, FIRMWARE_VERSION)) < self.settings.minimum_firmware:
            raise HardwareError(f"{name} has firmware {firmware}, older than {self.settings.minimum_firmware}")
        if errors := self.bus.read(motor, HARDWARE_ERROR):
            raise DeviceFaultError(f"{name} reports {hardware_errors(errors)}: turn its power off and on")

    def _connected(self, motor: int) -> list[tuple[Register, int]]:
        """What scales, shifts or limits a motor's motion, and what the driver lives by, in the order of writing."""
        P, I, D = self.settings.position_gains  # noqa: E741 - as they are called
        return [
            (RETURN_DELAY, 0),
            (DRIVE_MODE, 0),
            (OPERATING_MODE, OPERATING_MODES[self.settings.mode]),
            (SECONDARY_ID, NO_SECONDARY_ID),
            (PWM_LIMIT, MAX_PWM),
            (CURRENT_LIMIT, self.current_ticks[motor]),
            (VELOCITY_LIMIT, MAX_VELOCITY_LIMIT),
            (MAX_POSITION_LIMIT, TICKS_PER_TURN - 1),
            (MIN_POSITION_LIMIT, 0),
            (STARTUP_CONFIGURATION, 0),
            (SHUTDOWN, SHUTDOWN_BITS),
            (STATUS_RETURN_LEVEL, ANSWERS_EVERYTHING),
            (POSITION_P_GAIN, P),
            (POSITION_I_GAIN, I),
            (POSITION_D_GAIN, D),
            (FEEDFORWARD_1ST_GAIN, 0),
            (FEEDFORWARD_2ND_GAIN, 0),
        ]

    def _armed(self, motor: int) -> list[tuple[Register, int]]:
        """What a tripped watchdog has dropped, and what else limits the motion and does not outlive a restart."""
        return [
            (PROFILE_ACCELERATION, round(self.settings.profile_acceleration / ACCELERATION_UNIT)),
            (PROFILE_VELOCITY, round(self.settings.profile_velocity / VELOCITY_UNIT)),
            (GOAL_PWM, MAX_PWM),
            (GOAL_CURRENT, self.current_ticks[motor]),
        ]

    def configure(self) -> None:
        """Sets what every connection needs, torque being off: read of all, and written where it differs.

        Raises:
            CommunicationError: A motor does not answer.
            DeviceFaultError: A motor does not take a setting; the sentence says what it has and what is needed.
        """
        needed = {motor: self._connected(motor) for motor in self.ids}
        for k, (register, _) in enumerate(needed[self.ids[0]]):
            found = self.bus.sync_read(self.ids, register.address, register.length)
            for motor in self.ids:
                self._set(motor, register, register.decode(found[motor]), needed[motor][k][1])
        for motor in self.ids:
            self.bus.write(motor, BUS_WATCHDOG, 0)
            self.bus.write_bytes(motor, INDIRECT_ADDRESS, indirect_addresses())

    def _set(self, motor: int, register: Register, found: int, needed: int) -> None:
        """Writes a register that differs, and reads it back."""
        if found == needed or (register is SECONDARY_ID and found > MAX_ID):  # all of those are none
            return
        try:
            self.bus.write(motor, register, needed)
        except DeviceFaultError as error:
            raise DeviceFaultError(f"{self._wrong(motor, register, found, needed)}, and refuses it: {error}") from error
        if (kept := self.bus.read(motor, register)) != needed:
            raise DeviceFaultError(f"{self._wrong(motor, register, kept, needed)}, and does not take it")
        if register in (OPERATING_MODE, DRIVE_MODE):  # a motor forgets its turns on that, or counted them the other way
            erase_mark(self.bus, motor)

    def _wrong(self, motor: int, register: Register, found: int, needed: int) -> str:
        return f"{self.bus.name(motor)} has {register.name} {found}, needs {needed}"

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
                # A tripped watchdog refuses goals until it is cleared.
                self.bus.write(motor, BUS_WATCHDOG, 0)
                for register, value in (*self._armed(motor), (GOAL_POSITION, goals[motor])):
                    self.bus.write(motor, register, value)
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
        """The positions, if every limit is as written and no motor would turn further than to its goal.

        Some let their goal follow them without torque.
        """
        first = GOAL_PWM.address
        length = PRESENT_POSITION.address + PRESENT_POSITION.length - first
        positions = {}
        for motor, data in self.bus.sync_read(self.ids, first, length).items():

            def held(register: Register, data: bytes = data) -> int:
                return register.decode(data[register.address - first :][: register.length])

            for register, needed in self._armed(motor):
                if (found := held(register)) != needed:
                    raise DeviceFaultError(self._wrong(motor, register, found, needed))
            goal, position = held(GOAL_POSITION), held(PRESENT_POSITION)
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
