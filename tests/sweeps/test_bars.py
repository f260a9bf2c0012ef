"""Progress: told to a file by a job, drawn by the sweep, and only where there is a terminal."""

from __future__ import annotations

import io
import json
import time
from pathlib import Path

import pytest

from apcc_torch.experiments import folder
from apcc_torch.experiments.folder import progress_bar, progress_told
from apcc_torch.sweeps import bars as sweep_bars
from apcc_torch.sweeps.bars import SweepBars, running
from apcc_torch.sweeps.sweep_folder import SweepFolder


class Terminal(io.StringIO):
    def isatty(self) -> bool:
        return True


def job(path: Path, name: str, done: int, steps: int | None) -> Path:
    draft = path / f".{name}.1.draft"
    draft.mkdir(exist_ok=True)
    (draft / "progress.json").write_text(json.dumps({"label": "run", "done": done, "steps": steps}))
    return draft


def test_progress_is_told_to_the_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(folder, "_TELL_EVERY", 0.0)
    path = tmp_path / "progress.json"
    seen = []
    with progress_told(path):
        bar = progress_bar("run", True)
        assert list(progress_bar("run", False)(range(3))) == [0, 1, 2] and not path.exists()
    for step in bar(range(4)):
        seen.append((step, json.loads(path.read_text())))
    assert seen == [(k, {"label": "run", "done": k, "steps": 4}) for k in range(4)]
    assert [p.name for p in tmp_path.iterdir()] == ["progress.json"]


def test_telling_does_not_slow_the_steps_down(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    writes = []
    monkeypatch.setattr(folder.json, "dumps", lambda told: writes.append(told) or "{}")
    with progress_told(tmp_path / "progress.json"):
        assert sum(1 for _ in progress_bar("run", True)(range(1000))) == 1000
    assert 1 <= len(writes) <= 20, "a write every half second, not every step"


def test_running_jobs_are_read_from_their_drafts(tmp_path: Path) -> None:
    job(tmp_path, "10", 3, 4)
    job(tmp_path, "9", 1, None)
    (tmp_path / ".11.1.draft").mkdir()
    assert [(r.name, r.share) for r in running(SweepFolder(tmp_path))] == [("9", 0.0), ("10", 0.75)]


def test_a_terminal_gets_a_bar_a_job_and_one_for_the_sweep(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sweep_bars, "PERIOD", 0.02)
    monkeypatch.setenv("COLUMNS", "80")
    job(tmp_path, "0", 1, 2)
    job(tmp_path, "1", 1, 4)
    screen = Terminal()
    bars = SweepBars(SweepFolder(tmp_path), 3, screen)
    bars.start()
    deadline = time.monotonic() + 20.0
    while not all(part in screen.getvalue() for part in ("0: run", "1: run")) and time.monotonic() < deadline:
        time.sleep(0.02)
    bars.stop()
    drawn = screen.getvalue()
    assert "sweep, 0 of 3 jobs" in drawn and "0: run" in drawn and "1: run" in drawn
    # Half of one and a quarter of another of three jobs.
    assert " 25% |" in drawn and " 50% |" in drawn
    assert drawn.count("<") > 0, "the time left"


def test_without_a_terminal_nothing_is_drawn(tmp_path: Path) -> None:
    job(tmp_path, "0", 1, 2)
    screen = io.StringIO()
    bars = SweepBars(SweepFolder(tmp_path), 3, screen)
    bars.start()
    bars.stop()
    assert screen.getvalue() == ""
