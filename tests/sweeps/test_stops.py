"""A sweep as it is stopped: told in two lines, with nothing left running, its folder its own until then."""

from __future__ import annotations

import os
import shlex
import signal
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest
from hydra.core.override_parser.overrides_parser import OverridesParser

from apcc_torch import simulate
from apcc_torch.sweeps.claim import dir_override
from commands import ONE_BY_ONE, QUICK, command, descendants, environment
from started import Program

FOLDER = "a [sweep] of 'K' * 2"
KEYS = ("-m", *QUICK, "experiment.duration=600", "adaptation.gain_scale=0.5,1.0")
JOBLIB = "hydra/launcher=joblib"


@contextmanager
def running(cwd: Path, *arguments: str) -> Iterator[Program]:
    """A sweep whose jobs run, in a session of its own."""
    words = [*KEYS, *arguments, dir_override("hydra.sweep.dir", Path(FOLDER))]
    with Program("apcc_torch.simulate", words, cwd, environment(), session=True) as process:
        deadline = time.monotonic() + 300.0
        while not list(cwd.glob("a*/.*.draft/progress.json")):
            assert process.poll() is None, process.communicate()
            assert time.monotonic() < deadline
            time.sleep(0.05)
        yield process


def test_a_stopped_sweep_says_how_to_go_on(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    sweep = tmp_path / FOLDER
    with running(tmp_path, ONE_BY_ONE) as process:
        drafts = {path.name for path in sweep.glob(".*.draft")}
        quiet = ("hydra/job_logging=none", "hydra/hydra_logging=none", ONE_BY_ONE)
        monkeypatch.setattr(sys, "argv", ["", *KEYS, *quiet, dir_override("hydra.sweep.dir", sweep), "resume=true"])
        with pytest.raises(SystemExit) as refused:
            simulate.main()
        assert refused.value.code == 2
        assert f"{sweep} is in use by process {process.pid} on" in caplog.text
        assert drafts <= {path.name for path in sweep.glob(".*.draft")}, "the other's drafts are left alone"
        os.killpg(process.pid, signal.SIGINT)  # as a terminal does
        assert process.wait(120) == 130
        _, stopped, resume = "".join(process.communicate()).splitlines()
    assert stopped.endswith(f"stopped by Ctrl-C: 0 of 2 jobs are finished in {sweep}")
    words = shlex.split(resume.partition("is missing: ")[2])
    assert words[:-2] == [*command(*KEYS), ONE_BY_ONE] and words[-2] == "resume=true"
    assert OverridesParser.create().parse_override(words[-1]).value() == str(sweep)


def test_workers_end_with_a_head_that_is_killed(tmp_path: Path) -> None:
    pytest.importorskip("hydra_plugins.hydra_joblib_launcher")
    with running(tmp_path, JOBLIB) as process:
        workers = descendants(process.pid)
        assert len(workers) > 2
        process.kill()
        process.wait()
        deadline = time.monotonic() + 120.0
        while left := [pid for pid in workers if Path(f"/proc/{pid}/exe").exists()]:
            assert time.monotonic() < deadline, left
            time.sleep(0.1)
