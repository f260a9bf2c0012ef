"""All motors of a bus as one: checked, set up, torqued, read and let go together, in the registers' units."""

from __future__ import annotations

import secrets
from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping
from typing import Any, ClassVar, Protocol

import numpy as np

from apcc_torch.errors import CommunicationError, DeviceFaultError, HardwareError
from apcc_torch.hardware.interfaces import Array
from apcc_torch.hardware.servos.bus import ServoBus, raise_all
from apcc_torch.hardware.servos.register import Register
from apcc_torch.hardware.servos.spool import TICKS_PER_TURN
from apcc_torch.plain_text import plain_logger

log = plain_logger(__name__)

TORQUE_OFF_TRIES = 3
GOAL_SLACK = 8  # ticks that a hanging arm may move between two exchanges
LOST_TURN = TICKS_PER_TURN // 4  # ticks by which nothing moves as torque goes on


class ServoStatus(Protocol):
    """What one motor tells in one reading, in the registers' units."""

    @property
    def position(self) -> int:
        """Ticks."""

    @property
    def restarted(self) -> bool:
        """Whether the motor has lost what connecting wrote, and with it its count of turns."""


class ServoMotors(ABC):
    """The motors on a bus, in the order of their ids: what a driver of one make has to say of them.

    Args:
        bus: Their bus.
        ids: All of them.
        release_torqued: Whether connecting lets go of motors that hold torque.

    Attributes:
        torque: The register that switches torque. farthest: Ticks either way that a goal can have.
        marks: How many marks there are.
        fastest: (n_a,) ticks/s, more than a tendon's motor turns without load.
        armed: Whether torque is on.
    """

    torque: ClassVar[Register]
    farthest: ClassVar[int]
    marks: ClassVar[int]
    fastest: Array

    def __init__(self, bus: ServoBus, ids: tuple[int, ...], release_torqued: bool) -> None:
        self.bus = bus
        self.ids = ids
        self.release_torqued = release_torqued
        self.armed = False

    @abstractmethod
    def check(self) -> None:
        """Refuses motors that are not those of the settings, or not fit to run; writes nothing but a release."""

    @abstractmethod
    def configure(self) -> None:
        """Sets what every connection needs, torque being off: read of all, and written where it differs."""

    @abstractmethod
    def reachable(self) -> tuple[Mapping[int, ServoStatus], Mapping[int, HardwareError]]:
        """The status of the motors that answer, and why the others do not."""

    def status(self) -> Mapping[int, Any]:
        """Every motor's status, whatever it says. Raises CommunicationError if one does not answer."""
        status, wrong = self.reachable()
        raise_all(wrong.values())
        return status

    @abstractmethod
    def _fault(self, motor: int, state: Any) -> str:
        """What is wrong with a motor, in words, "" if nothing is."""

    @abstractmethod
    def speeds(self, status: Mapping[int, Any], ids: tuple[int, ...]) -> Array:
        """(n,) rad/s of some motors."""

    @abstractmethod
    def torques(self, status: Mapping[int, Any], ids: tuple[int, ...]) -> Array:
        """(n,) N m of some motors as far as they tell, elsewhere 0."""

    @abstractmethod
    def _prepare(self, goals: Mapping[int, int]) -> Mapping[int, int]:
        """Sets what limits the motion, and goals in ticks, and reads both back; returns the positions, ticks."""

    @abstractmethod
    def write_goals(self, goals: Mapping[int, int], hold: bool = False) -> None:
        """Goals in ticks, in one packet that no motor answers: a refusal shows in the next status.

        Args:
            goals: By id; motors that are left out keep theirs.
            hold: Whether no others follow for a while.
        """

    @abstractmethod
    def _mark(self, motor: int, mark: int | None) -> None:
        """Writes a motor's share of a mark, which a restart loses; None takes it off."""

    @abstractmethod
    def _bears(self, motor: int, mark: int) -> bool:
        """Whether a motor bears its share of a mark."""

    def leave_mark(self) -> int:
        """Writes a new mark, which a restart loses, to all motors; returns it."""
        mark = secrets.randbelow(self.marks)
        for motor in self.ids:
            self._mark(motor, mark)
        return mark

    def check_mark(self, mark: int) -> None:
        """Raises HardwareError, which names each motor that does not bear the mark."""
        lost = [self.bus.name(motor) for motor in self.ids if not self._bears(motor, mark)]
        if lost:
            raise HardwareError(
                f"{', '.join(lost)} lost power since that calibration, or has a newer one: calibrate again"
            )

    def erase_mark(self, motor: int) -> None:
        """Takes the mark off a motor whose count of turns is lost by what is done to it."""
        self._mark(motor, None)

    def arm(self, goals: Mapping[int, int]) -> None:
        """Torque on, with goals in ticks already set and read back.

        Raises:
            CommunicationError: A motor did not answer; all are let go.
            DeviceFaultError: A motor refuses, or does not hold what was written; all are let go.
        """
        try:
            before = self._prepare(goals)
            for motor in self.ids:
                self.bus.write(motor, self.torque, 1)
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

    def check_status(self, status: Mapping[int, ServoStatus]) -> None:
        """Raises DeviceFaultError, which names each motor with a fault and the fault."""
        faults: dict[str, list[str]] = {}
        for motor, state in status.items():
            if said := self._fault(motor, state):
                faults.setdefault(said, []).append(self.bus.name(motor))
        if faults:
            raise DeviceFaultError("; ".join(f"{', '.join(names)} {said}" for said, names in faults.items()))

    def refuse_torqued(self) -> None:
        """Raises HardwareError where a motor holds torque that nobody is known to have switched on, or lets it go."""
        torqued = [motor for motor in self.ids if self.bus.read(motor, self.torque)]
        if torqued and not self.release_torqued:
            names = ", ".join(self.bus.name(motor) for motor in torqued)
            raise HardwareError(f"{names} holds torque already; release_torqued=true lets go, and the arm drops")
        for motor in torqued:
            log.warning("%s held torque and is let go", self.bus.name(motor))
            self.bus.write(motor, self.torque, 0)

    def refuse_offset(self, offset: Register, tool: str) -> None:
        """Raises HardwareError where a motor shifts its positions, and takes its mark off.

        It is not written: whoever set it has to know that lengths from before mean something else.
        """
        for motor in self.ids:
            if found := self.bus.read(motor, offset):
                self.erase_mark(motor)
                raise HardwareError(f"{self._wrong(motor, offset, found, 0)}: set it with {tool} and calibrate again")

    def set(self, motor: int, register: Register, found: int, needed: int) -> bool:
        """Writes a register that differs, and reads it back; returns whether it differed.

        Raises:
            DeviceFaultError: The motor does not take it; the sentence says what it has and what is needed.
        """
        if found == needed:
            return False
        try:
            self.bus.write(motor, register, needed)
        except DeviceFaultError as error:
            raise DeviceFaultError(f"{self._wrong(motor, register, found, needed)}, and refuses it: {error}") from error
        if (kept := self.bus.read(motor, register)) != needed:
            raise DeviceFaultError(f"{self._wrong(motor, register, kept, needed)}, and does not take it")
        return True

    def _wrong(self, motor: int, register: Register, found: int, needed: int) -> str:
        return f"{self.bus.name(motor)} has {register.name} {found}, needs {needed}"

    def check_goal(self, motor: int, goal: int, position: int, wanted: int) -> None:
        """Raises DeviceFaultError where a motor would turn further than to its goal.

        Some let their goal follow them without torque.
        """
        if abs(goal - position) > abs(wanted - position) + GOAL_SLACK:
            raise DeviceFaultError(f"{self.bus.name(motor)} has goal {goal} instead of {wanted}")

    def torque_off(self) -> tuple[int, ...]:
        """Lets go of every motor, whatever fails on the way; returns those that did not confirm it."""
        self.armed = False
        left = list(self.ids)
        for attempt in range(TORQUE_OFF_TRIES):
            failed: dict[int, HardwareError] = {}
            try:
                self.bus.sync_write(self.torque, dict.fromkeys(left, 0))
            except CommunicationError as error:
                failed = dict.fromkeys(left, error)
            for motor in left:
                try:
                    self.bus.write(motor, self.torque, 0)
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


def each(status: Mapping[int, Any], ids: tuple[int, ...], value: Callable[[Any], float]) -> Array:
    """(n,) one number of some motors' status."""
    return np.array([value(status[motor]) for motor in ids], dtype=np.float64)
