"""One emulated STS3215: memory table with its lock, turns that are counted while there is power, motion, overload."""

from __future__ import annotations

from math import exp
from typing import NamedTuple

SIZE = 128
TICKS_PER_TURN = 4096
NO_LOAD_SPEED = 45 / 60 * TICKS_PER_TURN
GAIN = 40.0  # 1/s, of the approach to a near goal

TORQUE, ACCELERATION, GOAL, PWM_SPEED, SPEED, TORQUE_LIMIT, LOCK = 40, 41, 42, 44, 46, 48, 55
POSITION, PRESENT_SPEED, LOAD, STATUS, GOAL_COPY, CURRENT = 56, 58, 60, 65, 67, 69
RESPONSE, MIN_ANGLE, MAX_ANGLE, MAX_TORQUE, PHASE, OFFSET = 8, 9, 11, 16, 18, 31
FULL_ANGLE, FINE_SPEED = 16, 4
SIGN = 1 << 15
CALIBRATE = 128


class Field(NamedTuple):
    """A register that can be written: width, greatest magnitude, start value. Below address 40 it is EEPROM."""

    length: int
    most: int
    start: int


FIELDS = {
    5: Field(1, 253, 1),
    6: Field(1, 7, 0),
    RESPONSE: Field(1, 1, 1),
    MIN_ANGLE: Field(2, 4094, 0),
    MAX_ANGLE: Field(2, 4095, 4095),
    13: Field(1, 100, 70),
    MAX_TORQUE: Field(2, 1000, 1000),
    PHASE: Field(1, 254, 12),
    19: Field(1, 254, 44),
    21: Field(1, 254, 32),
    22: Field(1, 254, 32),
    23: Field(1, 254, 0),
    30: Field(1, 128, 1),
    OFFSET: Field(2, 8191, 0),
    33: Field(1, 3, 0),
    TORQUE: Field(1, CALIBRATE, 0),
    ACCELERATION: Field(1, 254, 0),
    GOAL: Field(2, 32_767, 0),
    PWM_SPEED: Field(2, 1000, 1000),
    SPEED: Field(2, 32_767, 0),
    TORQUE_LIMIT: Field(2, 1000, 1000),
    LOCK: Field(1, 1, 1),
}
SIGNED = {GOAL, SPEED}
EEPROM_END = 40


def magnitude(value: int) -> int:
    """A number as the servo has its sign: a bit beside the magnitude."""
    return value if value >= 0 else -value | SIGN


def number(word: int) -> int:
    """And back."""
    return -(word & ~SIGN) if word & SIGN else word


class Motor:
    """Its table is a byte string; position is kept as a float beside it, in ticks."""

    def __init__(self, identity: int, position: int, now: float, model: int = 777) -> None:
        self.memory = bytearray(SIZE)
        self.put(0, 1, 3)
        self.put(1, 1, 10)
        self.put(3, 2, model)
        for address, field in FIELDS.items():
            if address < EEPROM_END:
                self.put(address, field.length, field.start)
        # These have been used in this mode before.
        self.put(MAX_ANGLE, 2, 0)
        self.put(PHASE, 1, 12 | FULL_ANGLE)
        self.put(5, 1, identity)
        self.kept = bytes(self.memory[:EEPROM_END])
        self.position = 0.0
        self.load = 0
        self.tracks = False
        self.goals: list[int] = []  # every goal position that was written
        self.told = 0
        self.refused = 0
        self.calibrated = 0  # how often its middle was set anew
        self.goal_time = now
        self.held: float | None = None  # s between its last goal and the order to let go; None while it holds torque
        self.restart(now)
        self.position = float(position)
        self.reach = (self.position, self.position)
        self._show(0.0)

    def restart(self, now: float) -> None:
        """Power off and on: what the lock kept away is lost, and of the turns only the last is known."""
        self.memory[:EEPROM_END] = self.kept
        self.memory[EEPROM_END:] = bytes(SIZE - EEPROM_END)
        for address, field in FIELDS.items():
            if address >= EEPROM_END:
                self.put(address, field.length, field.start)
        self.put(TORQUE_LIMIT, 2, self.get(MAX_TORQUE, 2))
        self.position %= TICKS_PER_TURN
        self.put(GOAL, 2, self.shown)
        self.time = self.fed = now
        self._show(0.0)

    tripped = False  # it has no watchdog

    @property
    def shown(self) -> int:
        """The position as it tells it, in ticks: of one turn, or counted up to where its bits end."""
        ticks = round(self.position) + self.get(OFFSET, 2)
        if not self.memory[PHASE] & FULL_ANGLE:
            return ticks % TICKS_PER_TURN
        return (ticks + SIGN) % (2 * SIGN) - SIGN if abs(ticks) >= SIGN else ticks

    @property
    def goal(self) -> int:
        """The goal position, in ticks."""
        return number(self.get(GOAL, 2))

    @property
    def resting(self) -> bool:
        """Whether it is where it was sent."""
        return abs(self.position - self.goal) < 5

    @property
    def torque(self) -> int:
        """Whether it holds torque."""
        return self.memory[TORQUE]

    def get(self, address: int, length: int, signed: bool = False) -> int:
        return int.from_bytes(self.memory[address : address + length], "little", signed=signed)

    def put(self, address: int, length: int, value: int) -> None:
        self.memory[address : address + length] = (value % 256**length).to_bytes(length, "little")

    @property
    def speed_unit(self) -> float:
        """Ticks/s."""
        return (0.0146 if self.memory[PHASE] & FINE_SPEED else 0.732) / 60 * TICKS_PER_TURN

    def _show(self, speed: float) -> None:
        self.put(POSITION, 2, magnitude(self.shown))
        self.put(PRESENT_SPEED, 2, magnitude(round(speed / self.speed_unit)))
        duty = min(abs(self.load), 1000)
        self.put(LOAD, 2, duty | (1 << 10 if self.load < 0 else 0))
        self.put(CURRENT, 2, abs(self.load))
        self.put(62, 1, 120)
        self.put(63, 1, 30)
        self.put(GOAL_COPY, 2, self.get(GOAL, 2))
        if self.tracks and not self.memory[TORQUE]:
            self.put(GOAL, 2, magnitude(self.shown))

    def overload(self) -> None:
        """The protection: a fifth of the torque from now on, and a bit in the status until it restarts."""
        self.memory[STATUS] |= 0x20

    def advance(self, now: float) -> None:
        """Motion up to `now`, s."""
        dt, self.time = max(0.0, now - self.time), max(now, self.time)
        before = self.position
        if self.memory[TORQUE] and dt > 0:
            limit = self.get(SPEED, 2) * self.speed_unit or NO_LOAD_SPEED
            top = min(limit, NO_LOAD_SPEED)
            error = self.goal - self.get(OFFSET, 2) - self.position
            straight = max(0.0, (abs(error) - top / GAIN) / top)
            left = max(abs(error) - top * min(dt, straight), 0.0) * exp(-GAIN * max(0.0, dt - straight))
            self.position += error - (left if error > 0 else -left)
            self.reach = (min(self.reach[0], self.position), max(self.reach[1], self.position))
        self._show((self.position - before) / dt if dt > 0 else 0.0)

    def read(self, address: int, length: int) -> bytes:
        return bytes(self.memory[address : address + length])

    def write(self, address: int, data: bytes, now: float) -> None:
        """Takes what it can: values beyond a range are cut to it, and nothing says so."""
        place = 0
        while place < len(data):
            field = FIELDS.get(address + place)
            if field is None:
                place += 1
                continue
            piece = data[place : place + field.length]
            if len(piece) == field.length:
                self._take(address + place, field, int.from_bytes(piece, "little"), now)
            place += field.length

    def _take(self, at: int, field: Field, value: int, now: float) -> None:
        clipped = magnitude(max(-field.most, min(field.most, number(value))))
        value = clipped if at in SIGNED else min(value, field.most)
        if at == GOAL:
            self.goals.append(number(value))
            self.told += 1
            low, high = self.get(MIN_ANGLE, 2), self.get(MAX_ANGLE, 2)
            if low or high:
                value = max(low, min(high, number(value)))
            self.goal_time = now
        if at == TORQUE and value == CALIBRATE:
            self.calibrated += 1
            return
        before = self.memory[TORQUE]
        self.put(at, field.length, value)
        if at < EEPROM_END and not self.memory[LOCK]:
            self.kept = self.kept[:at] + bytes(self.memory[at : at + field.length]) + self.kept[at + field.length :]
        if at == TORQUE and value != before:
            self.held = None if value else now - self.goal_time
