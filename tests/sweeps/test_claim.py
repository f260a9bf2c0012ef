"""A program's folder: one process holds it, results are not written over unasked, and its name survives a shell."""

from __future__ import annotations

import os
import shlex
import signal
import sys
import threading
from pathlib import Path

import hypothesis
import pytest
from hydra.core.override_parser.overrides_parser import OverridesParser
from hypothesis import strategies as st
from omegaconf import DictConfig, OmegaConf

from apcc_torch import benchmark, evaluate, export, identify, robot, simulate
from apcc_torch.errors import ConfigError
from apcc_torch.processes import again
from apcc_torch.sweeps.claim import RESULTS, Claim, dir_override, given, place
from apcc_torch.sweeps.folder_lock import FolderLock


def config(kind: str, folder: str, *words: str, **settings: object) -> DictConfig:
    made = OmegaConf.create(
        {"overwrite": False, **settings, "hydra": {kind: {"dir": folder}, "overrides": {"hydra": list(words)}}}
    )
    assert isinstance(made, DictConfig)
    return made


@pytest.fixture(autouse=True)
def nothing_is_held(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(Claim, "held", None)


def test_a_folder_is_held_by_one_and_free_afterwards(tmp_path: Path) -> None:
    lock = FolderLock(tmp_path / "new")
    with pytest.raises(ConfigError, match=rf"{tmp_path / 'new'} is in use by process {os.getpid()} on .*; wait for it"):
        FolderLock(tmp_path / "new")
    lock.release()
    assert not list((tmp_path / "new").iterdir())
    FolderLock(tmp_path / "new").release()


def test_a_link_is_no_lock(tmp_path: Path) -> None:
    (tmp_path / "mine").write_text("kept")
    (tmp_path / "run").mkdir()
    (tmp_path / "run" / ".lock").symlink_to(tmp_path / "mine")
    with pytest.raises(ConfigError, match=r"run cannot be written to: .*symbolic links"):
        Claim.take(config("run", str(tmp_path / "run"), "hydra.run.dir=x"), "hydra.run.dir", "")
    assert (tmp_path / "mine").read_text() == "kept"


def test_a_killed_process_holds_nothing(tmp_path: Path) -> None:
    told, tells = os.pipe()
    pid = os.fork()
    if pid == 0:
        try:
            lock = FolderLock(tmp_path)
            os.write(tells, str(lock.path).encode())
            signal.pause()
        finally:
            os._exit(1)
    assert os.read(told, 1000)
    try:
        with pytest.raises(ConfigError, match=f"in use by process {pid} "):
            FolderLock(tmp_path)
    finally:
        os.kill(pid, signal.SIGKILL)
        os.waitpid(pid, 0)
    assert (tmp_path / ".lock").exists()
    FolderLock(tmp_path).release()


@pytest.mark.filterwarnings("error::pytest.PytestUnhandledThreadExceptionWarning")
def test_two_never_hold_it_however_they_meet(tmp_path: Path) -> None:
    holders, most, times = [0], [0], [0]

    def work() -> None:
        for _ in range(200):
            try:
                lock = FolderLock(tmp_path)
            except ConfigError:
                continue
            holders[0] += 1
            most[0], times[0] = max(most[0], holders[0]), times[0] + 1
            holders[0] -= 1
            lock.release()

    threads = [threading.Thread(target=work) for _ in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert most == [1] and times[0] > 0


def test_what_is_held_is_absolute_for_every_worker(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    asked = config("sweep", "here", "hydra.sweep.dir=here", "hydra.verbose=true")
    assert Claim.take(asked, "hydra.sweep.dir", None) == tmp_path / "here"
    assert asked.hydra.sweep.dir == str(tmp_path / "here")
    assert asked.hydra.overrides.hydra == ["hydra.verbose=true", f"hydra.sweep.dir={tmp_path / 'here'}"]
    with pytest.raises(ConfigError, match="is in use by process"):
        Claim.take(asked, "hydra.sweep.dir", None)


def test_runs_of_one_second_have_folders_of_their_own(tmp_path: Path) -> None:
    found: list[Path] = []
    threads = [
        threading.Thread(target=lambda: found.append(place(config("run", f"{tmp_path}/12-00-00"), "hydra.run.dir")))
        for _ in range(8)
    ]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert sorted(path.name for path in found) == ["12-00-00", *(f"12-00-00-{k}" for k in range(2, 9))]


@pytest.mark.parametrize("name", RESULTS)
@pytest.mark.parametrize(("kind", "inner", "results"), [("run", "", ""), ("sweep", "3/", "*/")])
def test_results_are_written_over_only_where_that_is_asked_for(
    tmp_path: Path, name: str, kind: str, inner: str, results: str
) -> None:
    (tmp_path / inner).mkdir(exist_ok=True)
    (tmp_path / inner / name).write_text("{}")
    beside = [
        tmp_path / inner / old for old in ("trajectory.npz", "points.csv", "figures/A/old.png", "points/3/config.yaml")
    ]
    own = [tmp_path / inner / kept for kept in ("notes.txt", "figures/mine.svg", "arm.yaml")]
    for path in [*beside, *own]:
        path.parent.mkdir(parents=True, exist_ok=True)
        path.touch()
    key = f"hydra.{kind}.dir"
    with pytest.raises(ConfigError, match=rf"holds results \({inner}{name}\).*{key}=DIR, or overwrite=true"):
        Claim.take(config(kind, str(tmp_path), f"{key}=x"), key, results)
    assert (tmp_path / inner / name).exists() and Claim.held is not None
    Claim.held.release()
    Claim.take(config(kind, str(tmp_path), f"{key}=x", overwrite=True), key, results)
    assert not (tmp_path / inner / name).exists()
    assert not any(path.exists() for path in beside) and all(path.exists() for path in own)


@pytest.mark.parametrize("name", ["file", "file/below"])
def test_a_folder_that_cannot_be_is_named(tmp_path: Path, name: str) -> None:
    (tmp_path / "file").touch()
    with pytest.raises(ConfigError, match=rf"{name} cannot be written to: .*; name another with hydra\.run\.dir=DIR"):
        Claim.take(config("run", str(tmp_path / name), "hydra.run.dir=x"), "hydra.run.dir", "")


@hypothesis.given(st.text(st.sampled_from("aZ0 _-./\\'\"[]{}()*?,=:~$@#%&|;<>!`+é\t\n"), min_size=1, max_size=12))
def test_a_pasted_command_names_the_same_folder(name: str) -> None:
    folder = Path("/" + name)
    was, sys.orig_argv = (
        sys.orig_argv,
        ["python", "-m", "p", "resume=false", "a.b=[1,2]", "hydra.sweep.dir='o l d'", "-m"],
    )
    try:
        words = shlex.split(again("resume=true", dir_override("hydra.sweep.dir", folder)))
    finally:
        sys.orig_argv = was
    assert [*words[:5], *words[6:]] == ["python", "-m", "p", "a.b=[1,2]", "resume=true", "-m"]
    override = OverridesParser.create().parse_override(words[5])
    assert not override.is_sweep_override()
    assert Path(OmegaConf.create({"dir": override.value()}).dir) == folder


PROGRAMS = {
    "simulate": (simulate, "run", ("experiment=kinematic",)),
    "benchmark": (benchmark, "run", ("grid=small",)),
    "identify": (identify.identification, "run", ("arm=ftdcr_v6", "data={sessions:{one:{file:one.csv}}}")),
    "evaluate": (evaluate.evaluation, "run", ("data=trunk",)),
    "export": (export.exported, "run", ("arm=arm_2",)),
    "robot": (robot.arm_run, "run", ("experiment=setpoint",)),
}


@pytest.fixture(params=PROGRAMS)
def program(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> str:
    """A program about to run into tmp_path/run, which stops itself as soon as it works."""
    module, work, words = PROGRAMS[request.param]
    monkeypatch.setattr(module, work, lambda *_: signal.raise_signal(signal.SIGINT))
    quiet = ("hydra/job_logging=none", "hydra/hydra_logging=none")  # the process's logging stays as it is
    monkeypatch.setattr(sys, "argv", [request.param, *words, f"hydra.run.dir={tmp_path / 'run'}", *quiet])
    return str(request.param)


def main(program: str) -> int:
    """Its exit code."""
    with pytest.raises(SystemExit) as ended:
        sys.modules[f"apcc_torch.{program}"].main()
    assert isinstance(ended.value.code, int)
    return ended.value.code


def test_every_program_is_stopped_in_one_sentence(
    program: str, tmp_path: Path, caplog: pytest.LogCaptureFixture, capfd: pytest.CaptureFixture[str]
) -> None:
    assert main(program) == 130
    told = [record.getMessage() for record in caplog.records if record.levelname == "ERROR"]
    assert told == [f"stopped by Ctrl-C; what is in {tmp_path / 'run'} is not finished: run the same command again"]
    assert "Traceback" not in "".join(capfd.readouterr())
    assert not (tmp_path / "run" / ".lock").exists()


def test_every_program_refuses_what_is_there(program: str, tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    (tmp_path / "run").mkdir()
    (tmp_path / "run" / "metrics.json").write_text("{}")
    assert main(program) == 2
    assert f"{tmp_path / 'run'} holds results (metrics.json)" in caplog.text
    assert [path.name for path in (tmp_path / "run").iterdir()] == ["metrics.json"]
    sys.argv.append("overwrite=true")
    assert main(program) == 130
    lock = FolderLock(tmp_path / "run")
    assert main(program) == 2
    assert f"is in use by process {os.getpid()} on" in caplog.text
    lock.release()


WRONG = {
    "simulate": ("experiment=kinematic", "experiment.duration=-1"),
    "benchmark": ("grid=small", "grid.setpoints=1000"),
    "identify": ("arm=ftdcr_v6", "data={sessions:{one:{file:none.csv}}}"),
    "robot": ("experiment=setpoint", "experiment.setpoints=[[0,0,0],[0,0,0.1]]"),
}


@pytest.mark.parametrize("name", WRONG)
def test_what_is_refused_leaves_no_folder(
    name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    quiet = ("hydra/job_logging=none", "hydra/hydra_logging=none")
    monkeypatch.setattr(sys, "argv", [name, *WRONG[name], f"hydra.run.dir={tmp_path / 'a' / 'run'}", *quiet])
    assert main(name) == 2 and caplog.text.count("ERROR") == 1
    assert not list(tmp_path.iterdir())
    (tmp_path / "a" / "run").mkdir(parents=True)
    assert main(name) == 2
    assert (tmp_path / "a" / "run").is_dir(), "a folder of the user's stays"


def test_of_a_refusal_in_the_middle_of_the_work_everything_stays(tmp_path: Path) -> None:
    Claim.take(config("run", str(tmp_path / "run"), "hydra.run.dir=x"), "hydra.run.dir", "")
    for name in (".hydra/config.yaml", "simulate.log", "config.yaml"):
        (tmp_path / "run" / name).parent.mkdir(exist_ok=True)
        (tmp_path / "run" / name).touch()
    (tmp_path / "run" / "log.mcap").touch()
    Claim.forget()
    assert (tmp_path / "run" / "config.yaml").exists()
    (tmp_path / "run" / "log.mcap").unlink()
    Claim.forget()
    assert not (tmp_path / "run").exists()


def test_no_run_begins_without_its_folder(caplog: pytest.LogCaptureFixture) -> None:
    """Hydra would warn of a callback's error, and go on."""
    asked = config("run", "${nope}", "hydra.run.dir=x")
    with pytest.raises(SystemExit) as ended:
        Claim().on_run_start(asked)
    assert ended.value.code == 2 and "Interpolation key 'nope' not found" in caplog.text


@pytest.mark.parametrize("value", ["${controller.null_gain}", "${nope}", "1.5"])
def test_words_are_given_as_they_were_written(value: str) -> None:
    made = OmegaConf.create({"overrides": {"task": [f"controller.K={value}"]}})
    assert isinstance(made, DictConfig)
    assert given(made) == [f"controller.K={value}"]
