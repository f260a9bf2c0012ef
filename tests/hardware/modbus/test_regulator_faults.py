"""Every fault of regulators through the whole runner: the real client against pymodbus's server in its own process.

What is asserted of each: the named reason with a sentence, the states, a whole log, and the chambers held or vented as
the regulators saw it. Cameras are those that are never wrong; theirs are in test_faults_end_to_end.py.
"""

from __future__ import annotations

import json
import math
import re
import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pytest

from apcc_torch.experiments import realtime_run as realtime
from apcc_torch.hardware.control import Control, Decision
from apcc_torch.hardware.log_reader import read_log
from apcc_torch.hardware.stops import StopReason
from composed import composed_realtime
from hardware.emulators.regulator.emulator import RegulatorEmulator
from hardware.faults import Left
from hardware.platform_runs import until

R, HELD, LET_GO, UNTOUCHED = StopReason, Left.HELD, Left.LET_GO, Left.UNTOUCHED
STATES = {
    HELD: ["armed", "running", "hold", "disarmed"],
    LET_GO: ["armed", "running", "fault"],
    UNTOUCHED: ["fault"],
}
PATIENT = (
    "arm=soft_trunk", "loop.warm_up=2", "loop.fresh_timeout=60", "loop.fresh_frames=2", "guards.max_pause=100",
    "guards.sensing.max_age=100", "guards.sensing.stale=100", "guards.sensing.dropout=100", "guards.max_error=null",
    "guards.overruns=100000", "view=false", "experiment.duration=100", "compile=off", "figures=false", "loop.rate=20",
    "hardware.world.kind=apcc_torch.hardware.world.RealWorld",
    "hardware.sensor.kind=hardware.modbus.still.StillSensor",
    "hardware.actuator.kind=apcc_torch.hardware.modbus.actuator.ModbusRegulators",
)  # fmt: skip
FEW = ("hardware.actuator.reply_timeout=0.4", "hardware.actuator.watchdog=3", "guards.failed_exchanges=2")
Make = Callable[[RegulatorEmulator], object]


@dataclass(frozen=True)
class Fault:
    """A row of the table; `alone`: units that nobody reaches any more, which vent by their own watchdog."""

    name: str
    make: Make
    reason: StopReason
    said: str
    left: Left
    alone: tuple[int, ...] = ()
    before: bool = False
    settings: tuple[str, ...] = ()
    spoilt: Callable[[Decision], Decision] | None = None


def unit(number: int, **changes: float) -> Make:
    return lambda server: server.do("set", number, **changes)


def gone(server: RegulatorEmulator) -> None:
    server.stop()


def nothing(server: RegulatorEmulator) -> None:
    """The fault is the controller's."""


def not_finite(decision: Decision) -> Decision:
    assert decision.pressure is not None
    return replace(decision, pressure=np.where(np.arange(6) == 3, math.nan, decision.pressure))


def buggy(decision: Decision) -> Decision:
    raise IndexError("list index out of range")


LATE = ("guards.overruns=15", "guards.overrun_window=20")
FAULTS = [
    Fault(
        "a unit that says nothing", unit(2, mute=9999), R.COMMUNICATION, "unit 2.*no reply", LET_GO, (2,), settings=FEW
    ),
    Fault("a unit that refuses", unit(1, refuse=9999), R.COMMUNICATION, "unit 1.*refuses", LET_GO, (1,), settings=FEW),
    Fault("a server that is gone", gone, R.COMMUNICATION, "unit 1.*no reply", LET_GO, (1, 2), settings=FEW),
    Fault("a fault that a unit tells", unit(2, status=4), R.DEVICE_FAULT, "unit 2.*bits 0x0004", LET_GO),
    Fault("a tripped watchdog", unit(1, watchdog=1), R.DEVICE_FAULT, "unit 1.*bits 0x0002", LET_GO),
    Fault("a pressure out of its range", unit(1, offset=14_000), R.TENDON_RANGE, "pressures .*kPa have left", HELD),
    Fault("replies too late for the loop", unit(1, late=0.12), R.OVERRUN, "missed deadlines", HELD, settings=LATE),
    Fault("a command that is not finite", nothing, R.COMMAND_NOT_FINITE, "pressures .*nan", HELD, spoilt=not_finite),
    Fault("an error in the program", nothing, R.INTERNAL_ERROR, "IndexError", LET_GO, spoilt=buggy),
    Fault("a wrong kind", unit(2, kind=3), R.NOT_CONNECTED, "unit 2 .*kind 3, not 77", UNTOUCHED, before=True),
    Fault("a fault from before", unit(1, status=1), R.NOT_CONNECTED, "unit 1 .*0x0001", UNTOUCHED, before=True),
    Fault("no server", gone, R.NOT_CONNECTED, "no Modbus server", UNTOUCHED, before=True),
    Fault("too much pressure", unit(1, offset=14_000), R.NOT_ARMED, "pressures are at .*140", UNTOUCHED, before=True),
]


@pytest.fixture(scope="module")
def shared() -> Iterator[RegulatorEmulator]:
    with RegulatorEmulator({1: 3, 2: 3}) as server:
        yield server


@pytest.fixture
def server(shared: RegulatorEmulator) -> RegulatorEmulator:
    """Regulators as they are switched on."""
    if shared.process.poll() is not None:
        shared.start()
    shared.do("fresh")
    return shared


def arguments(server: RegulatorEmulator, *more: str) -> list[str]:
    """Settings of a run on the regulators."""
    words = []
    for key, value in server.settings().items():
        told = list(value) if isinstance(value, tuple) else value
        words.append(f"hardware.actuator.{key}={str(told).replace(' ', '')}")
    return ["experiment=setpoint", *PATIENT, *words, *more]


@pytest.mark.parametrize("fault", [pytest.param(fault, id=fault.name) for fault in FAULTS])
def test_every_fault_ends_as_the_table_says(
    server: RegulatorEmulator, fault: Fault, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    under_way, over = threading.Event(), threading.Event()
    decide = Control.decide

    def decided(*given: object) -> Decision:
        decision = decide(*given)  # type: ignore[arg-type]
        return decision if fault.spoilt is None or not under_way.is_set() else fault.spoilt(decision)

    def make() -> None:
        until(lambda: over.is_set() or len(server.do("report")[1]["sent"]) > 5)
        if not over.is_set():
            fault.make(server)
            under_way.set()

    monkeypatch.setattr(Control, "decide", decided)
    if fault.before:
        fault.make(server)
    thread = threading.Thread(target=over.wait if fault.before else make)
    thread.start()
    hold = f"loop.hold={0.4 if fault.left is HELD else 60}"
    try:
        outcome, metrics = realtime.run(composed_realtime(*arguments(server, hold, *fault.settings)), tmp_path)
    finally:
        over.set()
        thread.join()
    assert outcome.reason is fault.reason, outcome.message
    assert metrics["exit_code"] == fault.reason.code and re.search(fault.said, outcome.message), outcome.message
    assert fault.before or under_way.is_set()
    events = json.loads((tmp_path / "events.json").read_text())["events"]
    assert [event["state"] for event in events if event["kind"] == "state"] == STATES[fault.left]
    log = read_log(tmp_path / "log.mcap")
    assert log.complete and log.events == events
    check_chambers(server, fault)


def check_chambers(server: RegulatorEmulator, fault: Fault) -> None:
    """Vented in the end, held before where it says so, and never told to leave the limits."""
    if server.process.poll() is not None:
        return  # without power a regulator has its own, mechanical, way to vent
    if fault.alone:
        until(lambda: all(not server.do("report")[number]["enabled"] for number in fault.alone))
    time.sleep(0.5)
    for number, told in server.do("report").items():
        sent = np.array(told["sent"])
        if fault.left is UNTOUCHED:
            assert not len(sent) and not told["log"]
            continue
        assert not told["enabled"] and max(told["pressure"]) < 100
        assert sent.min() >= 0 and sent.max() <= 12_000
        if number not in fault.alone:
            assert told["command"] == [0] * 3


def test_a_lost_reply_ends_nothing(server: RegulatorEmulator, tmp_path: Path) -> None:
    def make() -> None:
        until(lambda: len(server.do("report")[1]["sent"]) > 5)
        server.do("set", 1, mute=1)
        server.do("set", 2, refuse=1)

    thread = threading.Thread(target=make)
    thread.start()
    words = arguments(server, "loop.hold=0.1", "hardware.actuator.reply_timeout=0.5", "experiment.duration=5")
    outcome, _ = realtime.run(composed_realtime(*words), tmp_path)
    thread.join()
    assert outcome.reason is R.DURATION, outcome.message
    failed = [
        event["message"] for event in read_log(tmp_path / "log.mcap").events if event["kind"] == "exchange_failed"
    ]
    assert 1 <= len(failed) <= 3 and all(re.search("no reply|refuses", str(said)) for said in failed)
