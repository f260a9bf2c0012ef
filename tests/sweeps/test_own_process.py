"""Work in a process of its own: it ends well, or the caller can say how it ended, and goes on either way."""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path

import pytest

import isolated_work
from apcc_torch.sweeps.own_process import run_isolated


def test_what_ends_well_says_nothing_and_prints_into_the_log(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    log = tmp_path / "work.log"
    log.write_text("before\n")
    assert run_isolated(isolated_work.leaves, (tmp_path, "done"), log) is None
    assert (tmp_path / "left.txt").read_text() == "done"
    told = log.read_text()
    assert told.startswith("before\n") and "err\n" in told and "[apcc_torch.work][INFO] - logged" in told
    assert f"out {os.getpid()}" not in told and "out " in told, "the work ran in this process"
    assert capfd.readouterr() == ("", "")


@pytest.mark.parametrize(
    ("work", "why", "traced"),
    [
        (isolated_work.refuses, "speed must be positive, got -1", False),
        (isolated_work.breaks, "ZeroDivisionError: nothing to divide by", True),
        (isolated_work.is_killed, "killed by SIGKILL", False),
        (isolated_work.vanishes, "ended with exit code 7", False),
    ],
)
def test_what_ends_badly_is_told_in_one_sentence(
    tmp_path: Path, work: Callable[[], None], why: str, traced: bool
) -> None:
    log = tmp_path / "work.log"
    assert run_isolated(work, (), log) == why
    assert ("Traceback" in log.read_text()) == traced, "a stack is for bugs"
