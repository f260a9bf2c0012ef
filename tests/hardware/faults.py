"""The table of faults: how each is made on the emulated platform, and what the program has to make of it."""

from __future__ import annotations

import math
import os
import subprocess
import sys
import time
from collections.abc import Callable, Mapping
from contextlib import ExitStack
from dataclasses import dataclass, field, replace
from enum import Enum, auto
from pathlib import Path
from unittest.mock import patch

import numpy as np

from apcc_torch.errors import ValueRangeError
from apcc_torch.hardware.control import Decision
from apcc_torch.hardware.loop import Loop
from apcc_torch.hardware.stops import StopReason
from hardware.emulators.kinds import FEETECH, MOTORS, Kind
from hardware.emulators.rig import EmulatedPlatform
from hardware.platform_runs import SLOW

R = StopReason
MOTOR = MOTORS[3]
NAME = r"^motor 4 \(id 14\)"
HOLD = 0.5  # s for which an arm is held that is to be held
AT_ONCE = 60.0  # s for which one would be held that is to be let go at once


class When(Enum):
    """When a fault comes."""

    BEFORE = auto()  # the program starts
    UNDER_WAY = auto()  # the arm moves


BEFORE, UNDER_WAY = When


class Left(Enum):
    """How the arm is left."""

    HELD = auto()  # and let go after the hold
    LET_GO = auto()  # at once
    UNTOUCHED = auto()  # there was never any torque


HELD, LET_GO, UNTOUCHED = Left


@dataclass
class Scene:
    """A calibrated platform, and the way the controller is spoilt.

    spoilt: What is made of every decision of the controller. held_up: s that pass between taking a frame and its use.
    reply_timeout: s that the motors may take for a reply. over: What is to be taken back once the run is over. loop:
    The run's, once it turns.
    """

    platform: EmulatedPlatform
    calibration: Path
    over: ExitStack
    held_up: float = 0.0
    reply_timeout: float = 10.0
    spoilt: Callable[[Decision], Decision] = field(default=lambda decision: decision)
    loop: Loop | None = None

    @property
    def folder(self) -> Path:
        """Of the run."""
        return self.calibration.parent / "run"

    def limit(self, limits: Mapping[str, float]) -> None:
        """Tightens guards of the run that is under way, by their keys; `left` is the time that the run still has, s."""
        assert self.loop is not None
        setup = self.loop.setup
        holders = {"guards": self.loop.guards, "guards.sensing": setup.sensing, "hardware.sensor": setup.sensor}
        for key, value in limits.items():
            group, _, name = key.rpartition(".")
            if name == "left":
                now = setup.clock.now() - self.loop.started_at
                self.loop.setup = replace(setup, duration=now + value)
            else:
                holder = holders[group]
                holder.settings = replace(holder.settings, **{name: value})


Make = Callable[[Scene], object]


@dataclass(frozen=True)
class Fault:
    """A row of the table.

    make: Makes the fault. reason, said: The named reason, and what its sentence says. left: How the arm is left.
    alone: Motors that nobody reaches any more; they keep their torque. torqued: Motors that had torque before.
    settings: Keys that the fault needs. limits: Guards that are tightened once the fault is there: a busy machine might
        trip them before, as the arm is armed.
    """

    name: str
    make: Make
    reason: StopReason
    said: str
    left: Left
    when: When = UNDER_WAY
    alone: tuple[int, ...] = ()
    torqued: tuple[int, ...] = ()
    settings: tuple[str, ...] = (SLOW,)
    limits: Mapping[str, float] = field(default_factory=dict)

    @staticmethod
    def every() -> list[Fault]:
        """The whole table."""
        return [*MOTORS_WRONG, *CAMERAS_WRONG, *CONTROLLER_WRONG, *COMPUTER_WRONG, *WRONG_FROM_THE_START]

    @staticmethod
    def on(kind: Kind) -> list[Fault]:
        """The whole table for other motors: what their registers, units and protections make of its rows."""
        others = OTHERS.get(kind.name, {})
        table = [others.get(fault.name, fault) for fault in Fault.every()]
        return [fault for fault in table if fault is not None]

    @staticmethod
    def of_qualisys() -> list[Fault]:
        """What of the table cameras make, on Qualisys cameras, which say some of it in other words."""
        said = {
            "an unknown version after a restart": r"no new frame|QTM does not speak version 1\.25",
            "an unknown version": r"QTM does not speak version 1\.25 of its protocol: Version NOT supported",
            "no cameras": "no QTM answers",
        }
        first = [fault for fault in WRONG_FROM_THE_START if fault.name in (*said, "untracked from the start")]
        return [replace(fault, said=said.get(fault.name, fault.said)) for fault in (*CAMERAS_WRONG, *first)]

    @staticmethod
    def survived(name: str, make: Make) -> Fault:
        """One that the run outlives."""
        return Fault(name, make, R.DURATION, "s are over", HELD, limits={"left": 1.5})


def full_disk() -> Fault:
    """A disk that can take no more of the log; the program has to be in a process of its own."""
    return Fault("a full disk", lambda scene: None, R.LOG_FAILED, "the log cannot be written", HELD)


def stopped() -> Fault:
    """A process that is stopped for a while and goes on; it has to be one of its own."""
    return Fault("a stopped process", lambda scene: None, R.PAUSED, "the loop stood still for [1-9]", HELD)


def unanswered(make: Make) -> Make:
    """A fault of which motors that say nothing, or nonsense, are a part: nobody waits long for them."""

    def made(scene: Scene) -> None:
        scene.reply_timeout = 0.6
        make(scene)

    return made


def servo(order: str, **details: float) -> Make:
    """An order to the fourth motor."""
    return lambda scene: scene.platform.servos.do(order, MOTOR, **details)


def mocap(**faults: object) -> Make:
    """A fault of the cameras."""
    return lambda scene: scene.platform.cameras.fault(**faults)


def version(*numbers: int) -> Make:
    """Cameras that begin anew and speak another version."""
    return lambda scene: scene.platform.cameras.restart(version=numbers)


def controller(spoilt: Callable[[Decision], Decision]) -> Make:
    """A controller whose decisions are spoilt from now on."""
    return lambda scene: setattr(scene, "spoilt", spoilt)


def clock_set(scene: Scene) -> None:
    """The wall clock is set back by an hour, and then on by a day."""
    seconds, nanoseconds = time.time, time.time_ns
    for step in (-3600, 86_400):
        scene.over.enter_context(patch.object(time, "time", lambda step=step: seconds() + step))
        scene.over.enter_context(patch.object(time, "time_ns", lambda step=step: nanoseconds() + step * 10**9))
        time.sleep(0.2)


BUSY = "import os, sys\nos.sched_setaffinity(0, {int(sys.argv[1])})\nwhile True: pass"


def starved(scene: Scene) -> None:
    """Four programs that never wait share the loop's processor with it."""
    allowed = os.sched_getaffinity(os.getpid())  # of the main thread, where the loop is
    scene.over.callback(os.sched_setaffinity, os.getpid(), allowed)
    one = min(allowed)
    for _ in range(4):
        busy = scene.over.enter_context(subprocess.Popen([sys.executable, "-c", BUSY, str(one)]))
        scene.over.callback(busy.kill)
    os.sched_setaffinity(os.getpid(), {one})


def held_up(scene: Scene) -> None:
    scene.held_up = 0.5


def not_finite(decision: Decision) -> Decision:
    return replace(decision, y=np.where(np.arange(decision.y.size) == 3, math.nan, decision.y))


def refusing(decision: Decision) -> Decision:
    raise ValueRangeError("q must be finite")


def buggy(decision: Decision) -> Decision:
    raise IndexError("list index out of range")


def slow(decision: Decision) -> Decision:
    time.sleep(0.12)
    return decision


def far(decision: Decision) -> Decision:
    return replace(decision, e=decision.e + 3.0)


def failed(name: str, make: Make, said: str, alone: tuple[int, ...] = ()) -> Fault:
    """Motors that cannot be understood any more."""
    few = {"guards.failed_exchanges": 2}
    return Fault(name, unanswered(make), R.COMMUNICATION, said, LET_GO, alone=alone, limits=few)


def reported(name: str, make: Make, said: str) -> Fault:
    """A fault that the fourth motor tells."""
    return Fault(name, make, R.DEVICE_FAULT, f"{NAME} {said}", LET_GO)


def stale(name: str, make: Make, *settings: str) -> Fault:
    """Frames of which none can be used."""
    limits = {"guards.sensing.stale": 0.3}
    return Fault(name, make, R.SENSOR_STALE, r"no usable frame for \d", HELD, settings=(SLOW, *settings), limits=limits)


def dropped(name: str, make: Make, body: str) -> Fault:
    """One body that cannot be used."""
    # A busy machine may be without any frame for a moment; a body that is gone stays away for ever.
    limits = {"guards.sensing.dropout": 3.0}
    return Fault(name, make, R.SENSOR_DROPOUT, f"body {body} not usable", HELD, limits=limits)


def ended(name: str, make: Make, said: str) -> Fault:
    """A source of poses that is no more."""
    return Fault(name, make, R.SENSOR_LOST, said, HELD, limits={"hardware.sensor.timeout": 0.7})


def overrun(name: str, make: Make) -> Fault:
    """A turn that takes longer than a period."""
    few, rate = {"guards.overruns": 2, "guards.overrun_window": 5}, (SLOW, "loop.rate=20")
    return Fault(name, make, R.OVERRUN, "missed deadlines within 5 s", HELD, settings=rate, limits=few)


def first(
    name: str, make: Make, said: str, *settings: str, reason: StopReason = R.NOT_CONNECTED, torqued: int | None = None
) -> Fault:
    """A fault that is there before the program starts."""
    had = () if torqued is None else (torqued,)
    return Fault(name, unanswered(make), reason, said, UNTOUCHED, BEFORE, torqued=had, settings=settings)


BODIES = [2, 3, 4]
FAR = (SLOW, "guards.max_error=3")


def unplug(scene: Scene) -> object:
    return scene.platform.servos.do("unplug")


MOTORS_WRONG = [
    failed("a motor that says nothing", servo("mute"), r"2 readings .*motor 4 \(id 14\): no reply", alone=(MOTOR,)),
    failed("corrupt replies", servo("corrupt"), "motor 4 .*corrupt reply"),
    failed("replies that are too short", servo("short", amount=2), "motor 4 .*12 bytes of data instead of 14"),
    failed("the USB cable pulled out", unplug, "lost the port", alone=MOTORS),
    reported("a hardware error bit", servo("poke", address=70, length=1, value=4), "reports overheating"),
    reported("an overload", servo("overload"), "reports overload, and has let go"),
    reported("a tripped bus watchdog", servo("trip"), "has stopped: its bus watchdog tripped"),
    reported("a motor that lost power", servo("restart"), "has restarted and lost its zero"),
    Fault("a pull above the limit", servo("load", current=500), R.OVER_EFFORT, "^tendon 4 pulled 14", HELD),
    Fault("a pull above the cap", servo("load", current=1000), R.EFFORT_CAP, "^tendon 4 pulls 29", LET_GO),
    overrun("replies too late for the loop", servo("late", amount=0.12)),
]

CAMERAS_WRONG = [
    stale("no body tracked", mocap(untracked=BODIES)),
    dropped("one body untracked", mocap(untracked=[3]), "2"),
    stale("frozen poses", mocap(frozen=BODIES), "hardware.sensor.frozen_frames=5"),
    ended("a frozen frame number", mocap(frozen_number=True), "the frame number stays at"),
    stale("late frames", mocap(delay=0.7)),
    dropped("a body that jumps out of reach", mocap(jump={2: (0.3, 0, 0)}), "1"),
    stale("a base that moves", mocap(jump={1: (0.1, 0, 0)})),
    dropped("swapped bodies", mocap(swap=(2, 4)), "[13]"),
    stale("poses that are not numbers", mocap(nan=BODIES)),
    dropped("a zero quaternion", mocap(zero_quaternion=[3]), "2"),
    ended("truncated datagrams", mocap(truncate=60), r"[1-9]\d* of them damaged"),
    ended("a stream that stops", mocap(stop=True), "no new frame of motion capture"),
    ended("an unknown version after a restart", version(5, 0), r"no new frame|NatNet 5\.0"),
]

CONTROLLER_WRONG = [
    Fault("a command that is not finite", controller(not_finite), R.COMMAND_NOT_FINITE, "wants .*nan", HELD),
    Fault("a controller that refuses its input", controller(refusing), R.CONTROLLER_ERROR, "q must be finite", HELD),
    Fault("an error above its limit", controller(far), R.DIVERGENCE, "is 5.* m, the limit 3 m", HELD, settings=FAR),
    Fault("an error in the program", controller(buggy), R.INTERNAL_ERROR, "IndexError: list index", LET_GO),
    overrun("a controller that is too slow", controller(slow)),
]

FRESH = {"guards.sensing.max_age": 0.4, "guards.sensing.stale": 1.2}
FAST = {"settings": (SLOW, "loop.rate=500"), "limits": {"guards.overruns": 100}}

COMPUTER_WRONG = [
    Fault("frames that grow old before they are used", held_up, R.SENSOR_STALE, r"frame for [1-9]", HELD, limits=FRESH),
    Fault("a starved processor", starved, R.OVERRUN, "missed deadlines within 1 s", HELD, **FAST),
    Fault.survived("a wall clock that is set", clock_set),
]

WRONG_FROM_THE_START = [
    first("a wrong model", servo("poke", address=0, length=2, value=1020), f"{NAME} is model 1020, not 1030"),
    first("too old a firmware", servo("poke", address=6, length=1, value=37), f"{NAME} has firmware 37, older than 38"),
    first("homing offset", servo("poke", address=20, length=4, value=100), f"{NAME} has homing offset 100, needs 0"),
    first("torque already on", servo("poke", address=64, length=1, value=1), f"{NAME} holds torque", torqued=MOTOR),
    first("a hardware error from before", servo("poke", address=70, length=1, value=32), f"{NAME} reports overload"),
    first("a motor that is not there", servo("mute"), f"{NAME}: no reply"),
    first("no port", unplug, "servos"),
    first("an unknown version", version(5, 0), r"streams NatNet 5\.0; known are 3\.0"),
    first("no cameras", mocap(mute=True), "no NatNet server answers", "hardware.sensor.connect_timeout=0.5"),
    first("untracked from the start", mocap(untracked=[3]), "complete", "loop.fresh_timeout=0.5", reason=R.NOT_ARMED),
]

# Rows that Feetech's servos have otherwise; None: what does not exist there. They have no watchdog, and no firmware is
# too old.
STS_ROWS = [
    reported("a hardware error bit", servo("poke", address=65, length=1, value=4), "reports overheating"),
    reported("an overload", servo("overload"), "reports overload"),
    failed("replies that are too short", servo("short", amount=2), "motor 4 .*29 bytes of data instead of 31"),
    Fault("a pull above the limit", servo("load", current=250), R.OVER_EFFORT, "^tendon 4 pulled 14", HELD),
    Fault("a pull above the cap", servo("load", current=500), R.EFFORT_CAP, "^tendon 4 pulls 29", LET_GO),
    first("a wrong model", servo("poke", address=3, length=2, value=2825), f"{NAME} is model 2825, not 777"),
    first("homing offset", servo("poke", address=31, length=2, value=100), f"{NAME} has position offset 100, needs 0"),
    first("torque already on", servo("poke", address=40, length=1, value=1), f"{NAME} holds torque", torqued=MOTOR),
    first("a hardware error from before", servo("poke", address=65, length=1, value=32), f"{NAME} reports overload"),
]
NOT_THERE = ("a tripped bus watchdog", "too old a firmware")
OTHERS: dict[str, dict[str, Fault | None]] = {
    FEETECH.name: {fault.name: fault for fault in STS_ROWS} | dict.fromkeys(NOT_THERE)
}
