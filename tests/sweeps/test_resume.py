"""Kill -9 in the middle of a sweep, then resume: nothing lost, nothing twice, no half file."""

from __future__ import annotations

import json
import os
import signal
import time
from pathlib import Path

import pytest

from commands import ONE_BY_ONE, QUICK, children, environment, jobs, simulate
from started import Program

KEYS = ("-m", *QUICK, "experiment.duration=2", "velocity_filter.window=5,9,15,25,45", "hydra.sweep.dir=sweep")


def whole(sweep: Path) -> None:
    """Every visible folder is complete, and every file in it can be read."""
    for folder in sweep.iterdir():
        if folder.is_dir() and not folder.name.startswith("."):
            assert {"metrics.json", "job.json", "versions.json", "config.yaml", "trajectory.npz"} <= set(
                os.listdir(folder)
            )
            json.loads((folder / "metrics.json").read_text())


def finished(sweep: Path) -> int:
    return len(list(sweep.glob("[0-9]*/job.json")))


def killed_in_the_middle(cwd: Path, *arguments: str, after: int) -> None:
    """Starts a sweep and kills its whole process group while a job runs, once `after` jobs have ended."""
    deadline = time.monotonic() + 240.0
    sweep = cwd / "sweep"
    with Program("apcc_torch.simulate", arguments, cwd, environment(), session=True) as process:
        while time.monotonic() < deadline and process.poll() is None:
            if finished(sweep) >= after and list(sweep.glob(".*.draft/progress.json")):
                os.killpg(process.pid, signal.SIGKILL)
                break
            time.sleep(0.01)
        assert process.wait() == -signal.SIGKILL, "the sweep ended before it could be killed"


@pytest.mark.parametrize("launcher", ["basic", "joblib"])
def test_a_killed_sweep_goes_on(tmp_path: Path, launcher: str) -> None:
    if launcher == "joblib":
        pytest.importorskip("hydra_plugins.hydra_joblib_launcher")
    sweep = tmp_path / "sweep"
    killed_in_the_middle(tmp_path, *KEYS, f"hydra/launcher={launcher}", after=1)
    before = {path: path.stat().st_mtime_ns for path in sweep.glob("[0-9]*/metrics.json")}
    assert 1 <= len(before) < 5 and list(sweep.glob(".*.draft")), "killed while a job ran"
    whole(sweep)

    done = simulate(tmp_path, *KEYS, f"hydra/launcher={launcher}", "resume=true")
    assert done.returncode == 0, done.stdout + done.stderr
    whole(sweep)
    assert set(jobs(sweep)) == {f"velocity_filter.window={N}" for N in (5, 9, 15, 25, 45)}
    assert not [path.name for path in sweep.iterdir() if path.name.startswith(".")], "no draft is left"
    # What was there was not run again.
    assert before.items() <= {path: path.stat().st_mtime_ns for path in sweep.glob("[0-9]*/metrics.json")}.items()


def test_a_killed_job_is_named_and_the_others_go_on(tmp_path: Path) -> None:
    sweep = tmp_path / "sweep"
    words = [*KEYS, ONE_BY_ONE, "velocity_filter.window=5,9"]
    with Program("apcc_torch.simulate", words, tmp_path, environment()) as process:
        victim = None
        deadline = time.monotonic() + 240.0
        while victim is None and process.poll() is None and time.monotonic() < deadline:
            victim = worker_of(process.pid) if list(sweep.glob(".0.*.draft/progress.json")) else None
            time.sleep(0.01)
        assert victim is not None
        os.kill(victim, signal.SIGKILL)
        told = "".join(process.communicate(240))
    assert process.returncode == 1
    assert "failed: 0.failed, velocity_filter.window=5: killed by SIGKILL" in told
    assert set(jobs(sweep)) == {"velocity_filter.window=9"}

    done = simulate(tmp_path, *KEYS, ONE_BY_ONE, "velocity_filter.window=5,9", "resume=true")
    assert done.returncode == 0, done.stdout + done.stderr
    assert set(jobs(sweep)) == {"velocity_filter.window=5", "velocity_filter.window=9"}


def worker_of(pid: int) -> int | None:
    """The process that runs the job: a grandchild, forked from the one that has imported everything."""
    for child in children(pid):
        for grandchild in children(child):
            return grandchild
    return None


def test_a_resumed_sweep_may_be_larger(tmp_path: Path) -> None:
    first = simulate(tmp_path, "-m", ONE_BY_ONE, *QUICK, "seed=1,2", "hydra.sweep.dir=sweep")
    more = simulate(tmp_path, "-m", ONE_BY_ONE, *QUICK, "seed=3,2,1", "hydra.sweep.dir=sweep", "resume=true")
    assert first.returncode == more.returncode == 0, more.stdout
    assert set(jobs(tmp_path / "sweep")) == {"seed=1", "seed=2", "seed=3"}
