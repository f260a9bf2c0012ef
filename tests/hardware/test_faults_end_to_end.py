"""Every fault through the whole program, on emulated motors and cameras that each have a process of their own.

What is asserted of each: the exit code, the named reason with a sentence, a whole log, and the arm held or let go as
the motors saw it. A table says how a fault is made and what has to come of it. Nothing here depends on how fast a
machine is: a fault comes once the arm moves, and stays, and the guard that has to find it is tightened only then.
"""

from __future__ import annotations

import json
import logging
import re
import resource
import signal
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path

import numpy as np
import pytest
from hydra._internal.hydra import Hydra
from hydra.types import RunMode

from apcc_torch import robot
from apcc_torch.hardware.control import Control
from apcc_torch.hardware.interfaces import PoseSample
from apcc_torch.hardware.log_reader import RobotLog, read_log
from apcc_torch.hardware.loop import Loop
from apcc_torch.hardware.sensing import GatedFrame, Sensing
from apcc_torch.hardware.servos.port import BusPort
from apcc_torch.hardware.stops import StopReason
from apcc_torch.robot_log import main as robot_log
from hardware.emulators.kinds import DYNAMIXEL, FEETECH, MIXED_MODELS, MOTORS, VELOCITY
from hardware.emulators.rig import EmulatedPlatform
from hardware.faults import AT_ONCE, BEFORE, HOLD, UNDER_WAY, Fault, Left, Scene, full_disk, stopped, unanswered
from hardware.platform_runs import DEADLINE, SLOW, arguments, calibrated, moving, program, until

STATES = {
    Left.HELD: ["armed", "running", "hold", "disarmed"],
    Left.LET_GO: ["armed", "running", "fault"],
    Left.UNTOUCHED: ["fault"],
}


# Of motors other than the paper's these rows go with every run of the tests: each way that a driver of its own takes
# part in. All rows of all kinds: pytest tests/hardware/test_faults_end_to_end.py --every-kind
ALWAYS = {
    VELOCITY: ("corrupt replies", "a tripped bus watchdog", "no body tracked"),
    MIXED_MODELS: ("replies that are too short", "a pull above the limit"),
    FEETECH: ("the USB cable pulled out", "an overload", "a motor that lost power", "a pull above the limit"),
}


def pytest_generate_tests(metafunc: pytest.Metafunc) -> None:
    """The kinds of motors and the makes of cameras, and for each its table of faults."""
    if "fault" in metafunc.fixturenames:
        every = metafunc.config.getoption("--every-kind")
        optitrack, qualisys = (DYNAMIXEL, "optitrack"), (DYNAMIXEL, "qualisys")
        rows = [(optitrack, fault) for fault in Fault.every()]
        for kind, names in ALWAYS.items():
            rows += [((kind, "optitrack"), fault) for fault in Fault.on(kind) if every or fault.name in names]
        rows += [(qualisys, fault) for fault in Fault.of_qualisys()]
        before = {optitrack: "", qualisys: "qualisys-"}
        ids = [f"{before.get(rig, f'{rig[0].name}-')}{fault.name}" for rig, fault in rows]
        metafunc.parametrize(("platform", "fault"), rows, ids=ids, indirect=["platform"], scope="module")


@pytest.fixture(scope="module")
def platform(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Iterator[EmulatedPlatform]:
    kind, make = getattr(request, "param", (DYNAMIXEL, "optitrack"))
    with EmulatedPlatform(tmp_path_factory.mktemp("platform"), 100.0, kind, make) as platform:
        yield platform


@pytest.fixture
def scene(platform: EmulatedPlatform, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Scene]:
    """The platform as it hangs, calibrated, and a controller that can be broken."""
    decide, look, turn = Control.decide, Sensing.look, Loop.run

    def turning(loop: Loop) -> None:
        scene.loop = loop
        turn(loop)

    def looked(sensing: Sensing, sample: PoseSample | None, now: float) -> GatedFrame | None:
        frame = look(sensing, sample, now)
        time.sleep(scene.held_up)
        return frame

    with ExitStack() as over:
        scene = Scene(platform, tmp_path / "arm.json", over)
        patience = property(lambda port: scene.reply_timeout, lambda port, seconds: None)
        monkeypatch.setattr(BusPort, "reply_timeout", patience, raising=False)
        assert calibrated(platform, tmp_path) == scene.calibration
        monkeypatch.setattr(Control, "decide", lambda *given: scene.spoilt(decide(*given)))
        monkeypatch.setattr(Sensing, "look", looked)
        monkeypatch.setattr(Loop, "run", turning)
        # It composes all settings once more, only to see that this is no sweep.
        monkeypatch.setattr(Hydra, "get_mode", lambda hydra, config_name, overrides: RunMode.RUN)
        yield scene


@pytest.fixture(autouse=True)
def logging_as_before() -> Iterator[None]:
    """The program sets up logging for a process of its own."""
    root = logging.getLogger()
    level, handlers = root.level, root.handlers[:]
    yield
    for handler in set(root.handlers) - set(handlers):
        handler.close()
    root.handlers[:] = handlers
    root.setLevel(level)


def ran(scene: Scene, fault: Fault, monkeypatch: pytest.MonkeyPatch) -> int:
    """The program in this process, the fault coming in once the motors move; its exit code."""
    over, made = threading.Event(), threading.Event()

    def make() -> None:
        until(lambda: over.is_set() or (scene.loop is not None and moving(scene.platform)))
        if not over.is_set():
            fault.make(scene)
            scene.limit(fault.limits)
            made.set()

    if fault.when is BEFORE:
        fault.make(scene)
        made.set()
    thread = threading.Thread(target=make if fault.when is UNDER_WAY else over.wait)
    thread.start()
    hold = f"loop.hold={HOLD if fault.left is Left.HELD else AT_ONCE}"
    given = arguments(scene.platform, scene.calibration, hold, *fault.settings)
    monkeypatch.setattr(sys, "argv", ["apcc_torch.robot", *given, f"hydra.run.dir={scene.folder}"])
    try:
        with pytest.raises(SystemExit) as ended:
            robot.main()
    finally:
        over.set()
        thread.join()
    assert made.is_set(), f"it ended before the fault came: {ended.value.code}"
    return int(str(ended.value.code))


def test_every_fault_ends_as_the_table_says(scene: Scene, fault: Fault, monkeypatch: pytest.MonkeyPatch) -> None:
    before = scene.platform.servos.report()
    code = ran(scene, fault, monkeypatch)
    assert code == fault.reason.code
    assert json.loads((scene.folder / "metrics.json").read_text())["exit_code"] == code
    check_log(scene.folder, fault)
    check_motors(scene.platform, fault, before)


def check_log(folder: Path, fault: Fault) -> RobotLog:
    """The reason is named, once, with a sentence; the log is whole, and its reader says so."""
    events = json.loads((folder / "events.json").read_text())["events"]
    (stop,) = [event for event in events if event["kind"] == "stop"]
    assert stop["reason"] == events[-1]["reason"] == fault.reason.value and events[-1]["kind"] == "end"
    assert re.search(fault.said, stop["message"]), stop["message"]
    assert [event["state"] for event in events if event["kind"] == "state"] == STATES[fault.left]
    log = read_log(folder / "log.mcap")
    if fault.reason is StopReason.LOG_FAILED:
        assert not log.complete and log.events == events[: len(log.events)]  # what there was room for
    else:
        assert log.complete and log.events == events
    assert robot_log(["info", str(folder / "log.mcap")]) == 0
    if fault.when is not BEFORE:
        metrics = json.loads((folder / "metrics.json").read_text())
        timing, sent = log.topic("/timing"), log.topic("/tendons")["sent"]
        # The turn that ended the run has its row too; those of the hold follow.
        assert len(timing) >= (metrics["turns"] + 1 if log.complete else 1) and (np.diff(timing["time"]) > 0).all()
        assert np.isfinite(sent).all()
    return log


def check_motors(platform: EmulatedPlatform, fault: Fault, before: dict[int, dict[str, object]]) -> None:
    """The arm was held and then let go, or let go at once; no motor was ever told to go outside the limits."""
    if fault.alone and platform.kind.watchdog:
        # Nobody reaches these: their own watchdog stops them, with their torque on.
        until(lambda: all(platform.servos.report()[motor]["tripped"] for motor in fault.alone))
    report = platform.servos.report()
    assert platform.goals_in_limits()
    for motor, found in report.items():
        if fault.left is Left.UNTOUCHED:
            assert found["goals"] == before[motor]["goals"] and found["held"] is None
            assert found["torque"] == int(motor in fault.torqued)
        elif motor in fault.alone:
            assert found["torque"] == 1 and found["held"] is None
        else:
            assert found["torque"] == 0
            if fault.left is Left.HELD:
                # A busy emulator reads the last goal late, and stamps it so.
                assert found["held"] > HOLD / 2 and found["resting"]
            else:
                assert found["held"] is None or found["held"] < AT_ONCE


def logged(folder: Path, state: str) -> bool:
    """Whether the log of a run that goes on, which is brought up to date every second, has come to a state."""
    path = folder / "log.mcap"
    if not path.exists() or path.stat().st_size < 100:
        return False
    return state in [event["state"] for event in read_log(path).events]


def ticks_on_disk(folder: Path) -> int:
    """How many turns of the loop such a log has."""
    return len(read_log(folder / "log.mcap").topic("/timing"))


def test_a_disk_that_fills_up(scene: Scene) -> None:
    fault = full_disk()
    with program(scene.platform, scene.calibration, SLOW, f"loop.hold={HOLD}") as run:
        until(lambda: logged(scene.folder, "running") and moving(scene.platform))
        size = (scene.folder / "log.mcap").stat().st_size
        resource.prlimit(run.pid, resource.RLIMIT_FSIZE, (size, size))  # the log can grow no more
        told = "".join(run.communicate(DEADLINE))
    assert run.returncode == 60 and "log_failed: the log cannot be written" in told, told
    assert "Traceback" not in told
    check_log(scene.folder, fault)
    check_motors(scene.platform, fault, {})


def test_a_process_that_is_stopped_and_goes_on(scene: Scene) -> None:
    """It knows that it stood still, counts every period that it missed, and brings the arm to rest."""
    fault = stopped()
    # Half-way between what a busy machine may make it wait and the motors' own watchdog.
    with program(scene.platform, scene.calibration, SLOW, "guards.max_pause=1.2", f"loop.hold={HOLD}") as run:
        until(lambda: logged(scene.folder, "running") and moving(scene.platform))
        run.send_signal(signal.SIGSTOP)
        time.sleep(1.7)
        run.send_signal(signal.SIGCONT)
        told = "".join(run.communicate(DEADLINE))
    assert run.returncode == 51 and "paused: the loop stood still for" in told, told
    check_log(scene.folder, fault)
    check_motors(scene.platform, fault, {})
    metrics = json.loads((scene.folder / "metrics.json").read_text())
    assert metrics["missed_deadlines"] >= 75, "1.7 s at 50 Hz"


def test_kill_9(scene: Scene) -> None:
    """Nobody is left to stop the motors: they do it themselves, and hold; the log is whole up to its last second."""
    with program(scene.platform, scene.calibration, SLOW) as run:
        until(lambda: logged(scene.folder, "running") and ticks_on_disk(scene.folder) > 1 and moving(scene.platform))
        run.kill()
        run.wait(DEADLINE)
    until(lambda: all(motor["tripped"] for motor in scene.platform.servos.report().values()))
    first = scene.platform.servos.report()
    time.sleep(0.3)
    second = scene.platform.servos.report()
    assert [first[m]["position"] for m in MOTORS] == [second[m]["position"] for m in MOTORS]
    assert all(motor["torque"] == 1 for motor in second.values())  # held, not dropped
    assert scene.platform.goals_in_limits()
    log = read_log(scene.folder / "log.mcap")
    assert not log.complete and log.events[-1]["state"] == "running"
    assert len(log.topic("/timing")) > 1 and "calibration.json" in log.attachments
    assert robot_log(["replay", str(scene.folder / "log.mcap")]) == 0


@pytest.mark.parametrize(
    "platform", [(DYNAMIXEL, make) for make in ("optitrack", "qualisys")], indirect=True, ids=["optitrack", "qualisys"]
)
def test_small_faults_do_not_end_a_run(scene: Scene, monkeypatch: pytest.MonkeyPatch) -> None:
    """Lost and spoilt replies now and then, garbage, copies, and frames from another sender."""

    def make(scene: Scene) -> None:
        scene.platform.cameras.fault(garbage=3, foreign="127.0.0.2", duplicate=True)
        for motor, kind in zip(MOTORS, ("mute", "corrupt", "short", "cut"), strict=False):
            scene.platform.servos.do(kind, motor, count=1, amount=2)

    small = Fault.survived("small faults", unanswered(make))
    assert ran(scene, small, monkeypatch) == 0
    log = check_log(scene.folder, small)
    failed = [event["message"] for event in log.events if event["kind"] == "exchange_failed"]
    assert failed and all(re.search(r"no reply|corrupt reply|bytes of data", str(said)) for said in failed)
    assert log.topic("/controller")["time"][-1] > 1.0, "the controller went on"
    check_motors(scene.platform, small, {})
