"""python -m apcc_torch.robot as a user types it, on the simulated arm; and python -m apcc_torch.robot_log after it."""

from __future__ import annotations

import json
import signal
import subprocess
import time
from pathlib import Path

import numpy as np
import pytest

from apcc_torch.composition.build_realtime import RealtimeBuilder
from apcc_torch.experiments.realtime_run import settings_of
from apcc_torch.hardware.log_reader import read_log
from apcc_torch.hardware.log_replay import replay
from apcc_torch.native.function import NativeFunction
from apcc_torch.robot_log import main as robot_log
from commands import environment
from started import Program, ran

LOCKSTEP = ("hardware=lockstep", "hardware.world.step=0.01", "plant.settle=0.5", "loop.hold=0.1", "compile=off")
LOCKSTEP += ("figures=false", "controller.K=3.0")  # it arrives sooner
# A busy machine may starve the loop and the arm: these runs are about how they end, not about time.
PATIENT = (
    "loop.rate=20", "loop.warm_up=5", "loop.fresh_timeout=60", "loop.fresh_frames=1", "loop.hold=0.2",
    "plant.settle=0.1", "guards.overruns=100000", "guards.sensing.max_age=100", "guards.sensing.stale=100",
    "guards.sensing.dropout=100", "guards.sensing.gate.max_speed=100", "guards.sensing.gate.max_angular_rate=1000",
    "guards.max_error=null", "experiment.duration=100", "compile=off", "figures=false",
)  # fmt: skip


def robot(folder: Path, *arguments: str, limit: int | None = None) -> subprocess.CompletedProcess[str]:
    """Runs the command to its end; `limit` is the largest file it may write, bytes."""
    given = [*arguments, f"hydra.run.dir={folder / 'run'}"]
    return ran("apcc_torch.robot", given, folder, environment(), largest=limit)


@pytest.fixture(scope="module")
def finished(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, str]:
    """The folder of a run to the set-point in lockstep, and what was printed."""
    folder = tmp_path_factory.mktemp("robot")
    done = robot(folder, "experiment=setpoint", *LOCKSTEP)
    assert done.returncode == 0, done.stderr + done.stdout
    return folder / "run", done.stdout + done.stderr


def test_the_arm_arrives_within_a_millimetre(finished: tuple[Path, str]) -> None:
    folder, printed = finished
    metrics = json.loads((folder / "metrics.json").read_text())
    assert metrics["end_effector_error_start_mm"] > 100.0 and metrics["end_effector_error_end_mm"] < 1.0
    assert metrics["exit_code"] == 0 and metrics["missed_deadlines"] == 0 and metrics["diverged_rows"] == 0
    assert metrics["duration_s"] < 20.0
    assert "arrived: within 1 mm for 0.5 s" in printed and str(folder) in printed and "Traceback" not in printed
    written = {path.name for path in folder.iterdir()}
    assert {"config.yaml", "metrics.json", "versions.json", "events.json", "log.mcap", "robot.log"} <= written
    events = json.loads((folder / "events.json").read_text())["events"]
    assert [e["state"] for e in events if e["kind"] == "state"] == ["armed", "running", "hold", "disarmed"]


def test_the_true_arm_arrived_too(finished: tuple[Path, str]) -> None:
    """The last body is the end effector: its measured place is the set-point, whatever the controller says of it."""
    log = read_log(finished[0] / "log.mcap")
    tip = log.topic("/measurement")["poses"].reshape(-1, 3, 4, 4)[-20:, -1, :3, 3]
    assert np.linalg.norm(tip.mean(0) - [0.0, 0.15, -0.5]) < 1e-3


def test_a_replay_gives_the_same_commands(finished: tuple[Path, str], capsys: pytest.CaptureFixture[str]) -> None:
    path = str(finished[0] / "log.mcap")
    assert robot_log(["replay", path]) == 0
    assert "the same" in capsys.readouterr().out
    assert robot_log(["info", path]) == 0
    told = capsys.readouterr().out
    assert "complete" in told and "/controller" in told and "[arrived]" in told
    assert robot_log(["attachments", path]) == 0
    assert "LockstepWorld" in capsys.readouterr().out
    assert robot_log(["info", str(finished[0] / "metrics.json")]) == 2
    assert "not the log of a run" in capsys.readouterr().err


def test_other_settings_replay_to_other_commands(
    finished: tuple[Path, str], tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    record = read_log(finished[0] / "log.mcap")
    record.attachments["config.yaml"] = record.attachments["config.yaml"].replace("K: 3.0", "K: 2.9")
    monkeypatch.setattr("apcc_torch.robot_log.read_log", lambda path: record)
    assert robot_log(["replay", "log.mcap"]) == 1
    assert "not the same" in capsys.readouterr().out


def test_machine_code_gives_the_same_commands(finished: tuple[Path, str]) -> None:
    record = read_log(finished[0] / "log.mcap")
    control = RealtimeBuilder(settings_of(record).changed(compile="aot")).control()
    assert isinstance(control.step, NativeFunction)
    replayed = replay(record, control)
    assert len(replayed.time) > 100 and replayed.difference < 1e-9


def test_a_dry_run_moves_nothing(tmp_path: Path) -> None:
    done = robot(tmp_path, "experiment=setpoint", "dry_run=true", "experiment.duration=0.5", *LOCKSTEP)
    assert done.returncode == 0, done.stderr
    tendons = read_log(tmp_path / "run" / "log.mcap").topic("/tendons")
    assert np.abs(tendons["y"]).max() == 0.0 and np.abs(tendons["sent"]).max() > 1e-3


def test_a_run_leaves_figures_as_a_simulation_does(tmp_path: Path) -> None:
    short = ("experiment=setpoint", "experiment.duration=0.6", *LOCKSTEP, "figures=true")
    done = robot(tmp_path, *short)
    assert done.returncode == 0 and "is not drawn" not in done.stdout + done.stderr, done.stdout + done.stderr
    names = {path.stem for path in (tmp_path / "run" / "figures").iterdir()}
    wanted = {"shape_error", "psi", "parameters", "sensors", "end_effector", "mapping_error", "stroboscopic"}
    assert names == wanted | {"animation"}


@pytest.mark.parametrize(
    ("arguments", "code", "named"),
    [
        (("experiment=setpoint", "loop.rate=1000"), 2, "loop.rate must be in [20, 500], got 1000.0"),
        (("experiment=kinematic",), 2, "experiment.kind must be one of dynamic, tendons, got 'kinematic'"),
        (("experiment=setpoint", "guards.effort=3"), 2, "guards.effort is no setting; did you mean effort_cap?"),
    ],
)
def test_a_wrong_setting_is_named_and_nothing_runs(
    tmp_path: Path, arguments: tuple[str, ...], code: int, named: str
) -> None:
    done = robot(tmp_path, *arguments)
    assert done.returncode == code and "Traceback" not in done.stdout + done.stderr
    assert named in done.stdout + done.stderr
    assert not (tmp_path / "run" / "metrics.json").exists()


def test_a_full_disk_ends_the_run_by_name_with_the_arm_held(tmp_path: Path) -> None:
    done = robot(tmp_path, "experiment=setpoint", *PATIENT, "controller.K=0.01", limit=60_000)
    told = done.stdout + done.stderr
    assert done.returncode == 60, told
    assert "log_failed: the log cannot be written" in told and "the arm is disarmed" in told


def test_help_teaches(tmp_path: Path) -> None:
    done = robot(tmp_path, "--help", "experiment=setpoint", "hardware=dynamixel_optitrack")
    assert done.returncode == 0, done.stderr
    choices = ("\nexperiment\n", "    setpoint  ", "    dynamixel_optitrack  ", "    lockstep  ", "    simulated  ")
    meaning = "hardware.actuator.bus_watchdog=0.1 s", "[ours] without a packet", "hardware.sensor  OptiTrackSensor"
    for part in (*choices, *meaning, "dry_run", "sensor_stale", "143", "robot_log"):
        assert part in done.stdout, part


@pytest.mark.parametrize(("number", "again", "code"), [(signal.SIGINT, True, 130), (signal.SIGTERM, False, 143)])
def test_signals_in_real_time_hold_the_arm_and_close_the_log(
    tmp_path: Path, number: signal.Signals, again: bool, code: int
) -> None:
    folder = tmp_path / "run"
    hold = "loop.hold=300" if again else "loop.hold=0.2"
    given = ["experiment=setpoint", *PATIENT, hold, "controller.K=0.01", f"hydra.run.dir={folder}"]
    with Program("apcc_torch.robot", given, tmp_path, environment()) as run:
        _wait_for(folder, "running")
        run.send_signal(number)
        if again:
            _wait_for(folder, "hold")
            run.send_signal(number)
        told = "".join(run.communicate(120))
    assert run.returncode == code, told
    log = read_log(folder / "log.mcap")
    assert log.complete and log.events[-1]["kind"] == "end"
    assert [e["state"] for e in log.events if e["kind"] == "state"] == ["armed", "running", "hold", "disarmed"]
    assert robot_log(["replay", str(folder / "log.mcap")]) == 0


def _states(folder: Path) -> list[object]:
    path = folder / "log.mcap"
    if not path.exists() or path.stat().st_size < 100:
        return []
    return [event["state"] for event in read_log(path).events if event["kind"] == "state"]


def _wait_for(folder: Path, state: str) -> None:
    """Until the log, which is brought up to date every second, says so."""
    end = time.monotonic() + 120.0
    while state not in _states(folder):
        assert time.monotonic() < end, f"the run did not come to {state}"
        time.sleep(0.2)
