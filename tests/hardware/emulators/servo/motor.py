"""One emulated motor of the X series: control table, motion, bus watchdog, shutdown."""

from __future__ import annotations

from functools import cache
from math import exp
from typing import NamedTuple

from hardware.emulators.servo.models import TABLES, XM430_W210, Table

SIZE = 700
TICKS_PER_TURN = 4096
TICKS_PER_SPEED_UNIT = 0.229 / 60 * TICKS_PER_TURN
GAIN = 40.0  # 1/s, of the approach to a near goal

OK, RESULT_FAIL, INSTRUCTION, DATA_RANGE, DATA_LENGTH, ACCESS = 0, 1, 2, 4, 5, 7
ALERT = 0x80

MODE, TORQUE, HARDWARE_ERROR, WATCHDOG, GOAL, POSITION = 11, 64, 70, 98, 116, 132
DRIVE_MODE, HOMING, PWM_LIMIT, CURRENT_LIMIT, VELOCITY_LIMIT, MAX_POSITION, MIN_POSITION = 10, 20, 36, 38, 44, 48, 52
P_GAIN, GOAL_PWM, GOAL_CURRENT, PROFILE_ACCELERATION, PROFILE_VELOCITY = 84, 100, 102, 108, 112
GOAL_VELOCITY = 104
GOALS = {100, 102, 104, 116}
LIMITED = {
    GOAL_PWM: (PWM_LIMIT, 2),
    GOAL_CURRENT: (CURRENT_LIMIT, 2),
    GOAL_VELOCITY: (VELOCITY_LIMIT, 4),
    PROFILE_VELOCITY: (VELOCITY_LIMIT, 4),
}
INDIRECT_ADDRESS = 168
VELOCITY = 1  # the operating mode


class Field(NamedTuple):
    """A register that can be written: width, range, start value, sign. Below address 64 it is kept without power."""

    length: int
    low: int
    high: int
    start: int
    signed: bool = False


PWM = 885


@cache
def fields(model: int) -> dict[int, Field]:
    """The registers of a model that can be written, by their address."""
    table = TABLES[model]
    found = {
        7: Field(1, 0, 252, 1),
        8: Field(1, 0, 7, 3),
        9: Field(1, 0, 254, 250),
        10: Field(1, 0, 5, 0),
        11: Field(1, 0, 16, 5 if table.current else 4),  # 3 from the factory; these have been used
        12: Field(1, 0, 255, 255),
        20: Field(4, -1_044_479, 1_044_479, 0, True),
        31: Field(1, 0, 100, 80),
        36: Field(2, 0, PWM, PWM),
        44: Field(4, 0, table.velocity, 330),
        48: Field(4, 0, 4095, 4095),
        52: Field(4, 0, 4095, 0),
        60: Field(1, 0, 3, 0),
        63: Field(1, 0, 255, table.shutdown),
        64: Field(1, 0, 1, 0),
        65: Field(1, 0, 1, 0),
        68: Field(1, 0, 2, 2),
        98: Field(1, 0, 127, 0),
        100: Field(2, -PWM, PWM, PWM, True),
        104: Field(4, -table.velocity, table.velocity, 0, True),
        108: Field(4, 0, 32767, 0),
        112: Field(4, 0, 32767, 0),
        116: Field(4, -1_048_575, 1_048_575, 0, True),
    }
    if table.current:
        found[38] = Field(2, 0, table.current, table.current)
        found[102] = Field(2, -table.current, table.current, table.current, True)
    found |= {address: Field(2, 0, 16_383, start) for address, start in gains(table).items()}
    last, data = (661 if table.slots == 28 else 227), INDIRECT_ADDRESS + 2 * table.slots
    return found | {INDIRECT_ADDRESS + 2 * k: Field(2, 64, last, data + k) for k in range(table.slots)}


def gains(table: Table) -> dict[int, int]:
    """The gains of the position control as delivered, by their address."""
    return {80: table.d_gain, 82: 0, P_GAIN: table.p_gain, 88: 0, 90: 0}


class Motor:
    """Its table is a byte string; position is kept as a float beside it, in ticks."""

    def __init__(self, identity: int, position: int, now: float, model: int = XM430_W210) -> None:
        self.table = TABLES[model]
        self.fields = fields(model)
        self.gains = gains(self.table)
        self.data = INDIRECT_ADDRESS + 2 * self.table.slots
        self.memory = bytearray(SIZE)
        self.put(0, 2, model)
        self.put(6, 1, 52)
        for address, field in self.fields.items():
            if address < 64:
                self.put(address, field.length, field.start)
        self.put(7, 1, identity)
        self.position = 0.0
        self.load = 0
        self.tracks = False  # whether the goal follows the position while torque is off
        self.goals: list[int] = []  # every goal position that was written, taken or refused
        self.told = 0  # how many goals, of position or velocity
        self.reach = (float(position), float(position))  # the least and the greatest position with torque
        self.refused = 0
        self.goal_time = now
        self.held: float | None = None  # s between its last goal and the order to let go; None while it holds torque
        self.restart(now)
        self.position = float(position)  # turned since its start
        self._show(0.0)
        self.reach = (self.position, self.position)

    def restart(self, now: float) -> None:
        """Power off and on: what is not kept is at its start, and of the turns only the last is known."""
        self.memory[64:] = bytes(SIZE - 64)
        for address, field in self.fields.items():
            if address >= 64:
                self.put(address, field.length, field.start)
        self.position %= TICKS_PER_TURN
        self._reset_limits()
        self.put(GOAL, 4, self.shown)
        self.stopped = False
        self.time = self.fed = now
        self._show(0.0)

    def _reset_limits(self) -> None:
        """What a start and another operating mode set anew."""
        for address, start in {**self.gains, PROFILE_ACCELERATION: 0, PROFILE_VELOCITY: 0}.items():
            self.put(address, self.fields[address].length, start)
        self.put(GOAL_PWM, 2, self.get(PWM_LIMIT, 2))
        self.put(GOAL_VELOCITY, 4, 0)
        if self.table.current:
            self.put(GOAL_CURRENT, 2, self.get(CURRENT_LIMIT, 2))

    @property
    def sign(self) -> int:
        """Which way it counts its turns."""
        return -1 if self.memory[DRIVE_MODE] & 1 else 1

    @property
    def shown(self) -> int:
        """The position as it tells it, in ticks."""
        return round(self.sign * self.position) + self.get(HOMING, 4, True)

    @property
    def goal(self) -> int:
        """The goal position, in ticks."""
        return self.get(GOAL, 4, True)

    @property
    def moves_by_velocity(self) -> bool:
        """Whether it is told velocities."""
        return self.memory[MODE] == VELOCITY

    @property
    def resting(self) -> bool:
        """Whether it is where it was sent, or was told to stand."""
        if self.moves_by_velocity:
            return self.get(GOAL_VELOCITY, 4, True) == 0
        return abs(self.position - self.goal) < 5

    @property
    def torque(self) -> int:
        """Whether it holds torque."""
        return self.memory[TORQUE]

    @property
    def tripped(self) -> bool:
        """Whether its watchdog has tripped."""
        return self.memory[WATCHDOG] == 0xFF

    def get(self, address: int, length: int, signed: bool = False) -> int:
        return int.from_bytes(self.memory[address : address + length], "little", signed=signed)

    def put(self, address: int, length: int, value: int) -> None:
        self.memory[address : address + length] = (value % 256**length).to_bytes(length, "little")

    def _show(self, speed: float) -> None:
        self.put(126, 2, self.load)
        self.put(144, 2, self.table.supply)
        self.put(128, 4, round(self.sign * speed / TICKS_PER_SPEED_UNIT))
        self.put(POSITION, 4, self.shown)
        if self.tracks and not self.memory[TORQUE]:
            self.put(GOAL, 4, self.shown)

    def overload(self) -> None:
        """The shutdown of an overload: the motor lets go and stays so until it restarts."""
        self.memory[HARDWARE_ERROR] |= 0x20
        self.memory[TORQUE] = 0

    def advance(self, now: float) -> None:
        """Motion and watchdog up to `now`, s."""
        allowed = 0.02 * self.memory[WATCHDOG]
        if self.memory[TORQUE] and 1 <= self.memory[WATCHDOG] <= 127 and now - self.fed > allowed:
            self._move(self.fed + allowed)
            self.memory[WATCHDOG] = 0xFF
            self.stopped = True
            self.put(108, 4, 0)
            self.put(112, 4, 0)
        self._move(now)

    def _move(self, now: float) -> None:
        dt, self.time = max(0.0, now - self.time), max(now, self.time)
        before = self.position
        if self.memory[TORQUE] and not self.stopped and dt > 0:
            reach = self.table.speed / 60 * TICKS_PER_TURN * max(self.get(GOAL_PWM, 2, True), 1) / PWM
            if self.moves_by_velocity:
                speed = self.sign * self.get(GOAL_VELOCITY, 4, True) * TICKS_PER_SPEED_UNIT
                self.position += min(max(speed, -reach), reach) * dt
                self._moved(before, dt)
                return
            top = min(self.get(PROFILE_VELOCITY, 4) * TICKS_PER_SPEED_UNIT or reach, reach)
            gain = GAIN * max(self.get(P_GAIN, 2), 1) / self.gains[P_GAIN]
            error = self.sign * (self.get(GOAL, 4, True) - self.get(HOMING, 4, True)) - self.position
            straight = max(0.0, (abs(error) - top / gain) / top)
            left = max(abs(error) - top * min(dt, straight), 0.0) * exp(-gain * max(0.0, dt - straight))
            self.position += error - (left if error > 0 else -left)
        self._moved(before, dt)

    def _moved(self, before: float, dt: float) -> None:
        if self.memory[TORQUE]:
            self.reach = (min(self.reach[0], self.position), max(self.reach[1], self.position))
        self._show((self.position - before) / dt if dt > 0 else 0.0)

    def _address(self, address: int) -> int:
        """Where a byte really lies."""
        slot = address - self.data
        return self.get(INDIRECT_ADDRESS + 2 * slot, 2) if 0 <= slot < self.table.slots else address

    def read(self, address: int, length: int) -> tuple[int, bytes]:
        """Error number and data."""
        if address + length > SIZE:
            return ACCESS, b""
        return OK, bytes(self.memory[self._address(address + k)] for k in range(length))

    def write(self, address: int, data: bytes, now: float) -> int:
        """Error number. Nothing is written if a part cannot be."""
        parts: list[tuple[int, Field, int]] = []
        place = 0
        while place < len(data):
            field = self.fields.get(address + place)
            if field is None:
                return ACCESS
            piece = data[place : place + field.length]
            if len(piece) < field.length:
                return DATA_LENGTH
            parts.append((address + place, field, int.from_bytes(piece, "little", signed=field.signed)))
            place += field.length
        for at, field, value in parts:
            if at == GOAL:
                self.goals.append(value)
            self.told += at in (GOAL, GOAL_VELOCITY)
            if error := self._refusal(at, field, value):
                self.refused += at in (GOAL, GOAL_VELOCITY)
                return error
        for at, field, value in parts:
            before = self.get(at, field.length)
            self.put(at, field.length, value)
            if at == MODE and value != before:
                self.position %= TICKS_PER_TURN
                self._reset_limits()
            if at == WATCHDOG and value == 0:
                self.stopped = False
            elif at == GOAL or (at == GOAL_VELOCITY and value != before):
                self.goal_time = now
            elif at == TORQUE and value != before:
                self.held = None if value else now - self.goal_time
        self.fed = now
        return OK

    def _refusal(self, address: int, field: Field, value: int) -> int:
        if address < 64 and self.memory[TORQUE]:
            return ACCESS
        if not field.low <= value <= field.high or (address in GOALS and self.memory[WATCHDOG] == 0xFF):
            return DATA_RANGE
        if address in LIMITED and abs(value) > self.get(*LIMITED[address]):
            return DATA_RANGE
        if address == GOAL and self.memory[MODE] == 3:  # the only mode that has these limits
            return OK if self.get(MIN_POSITION, 4) <= value <= self.get(MAX_POSITION, 4) else DATA_RANGE
        if address == TORQUE and value and self.memory[HARDWARE_ERROR] & self.memory[63]:
            return RESULT_FAIL
        return OK
