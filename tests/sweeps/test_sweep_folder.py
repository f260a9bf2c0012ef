"""The folder of a sweep: jobs are complete or absent, found by what they are, and never written over."""

from __future__ import annotations

import errno
import json
import logging
import math
import os
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from apcc_torch.composition.run_settings import SimulateSettings
from apcc_torch.errors import ConfigError
from apcc_torch.sweeps.bars import SweepBars
from apcc_torch.sweeps.callback import OpenSweep, Plan
from apcc_torch.sweeps.job import run_job
from apcc_torch.sweeps.sweep_folder import SweepFolder, fingerprint, job_name
from composed import changed, raw


def settings(*overrides: str) -> SimulateSettings:
    return changed("kinematic", *overrides)


def draft(sweep: SweepFolder, name: str, stamp: int = 1) -> Path:
    folder = sweep.path / f".{name}.{stamp}.draft"
    folder.mkdir(parents=True)
    (folder / "metrics.json").write_text('{"a": 1}')
    return folder


@pytest.fixture
def sweep(tmp_path: Path) -> SweepFolder:
    return SweepFolder(tmp_path / "sweep")


def test_a_folder_that_is_not_there_is_empty(sweep: SweepFolder) -> None:
    assert not list(sweep.finished()) and not list(sweep.drafts()) and not sweep.failures()
    sweep.clear()
    assert not sweep.path.exists()


def test_a_draft_becomes_the_job_as_a_whole(sweep: SweepFolder) -> None:
    work = draft(sweep, "4")
    assert not list(sweep.finished()) and list(sweep.drafts()) == [work]
    place = sweep.publish(work, settings("seed=4"), ["seed=4"])
    assert place == sweep.path / "4" and list(sweep.finished()) == [place] and not list(sweep.drafts())
    assert json.loads((place / "job.json").read_text())["overrides"] == ["seed=4"]
    assert (place / "metrics.json").is_file()


def test_nothing_is_written_over(sweep: SweepFolder) -> None:
    first = sweep.publish(draft(sweep, "0", 1), settings("seed=1"), ["seed=1"])
    second = sweep.publish(draft(sweep, "0", 2), settings("seed=2"), ["seed=2"])
    assert (first.name, second.name) == ("0", "0-2")
    assert sweep.find(settings("seed=1"), "0") == first and sweep.find(settings("seed=2"), "0") == second


def test_a_job_is_found_by_what_it_is_not_by_its_name(sweep: SweepFolder) -> None:
    place = sweep.publish(draft(sweep, "7"), settings("seed=3", "objective=a"), ["seed=3"])
    # Neither its number nor how it is computed or judged makes it another run.
    again = settings("seed=3", "resume=true", "jobs=5", "progress=false", "objective=b", "prune.after=1")
    assert sweep.find(again, "0") == place == sweep.find(again, "7")
    assert sweep.find(settings("seed=4"), "7") is None
    sweep.rename_job(place, ["seed=3", "resume=true"])
    assert json.loads((place / "job.json").read_text())["overrides"] == ["seed=3", "resume=true"]
    assert sweep.find(again, "0") == place


@pytest.mark.parametrize(
    ("overrides", "same"),
    [((), True), (("prune.above=8",), False), (("prune.after=2",), False), (("objective=b",), False)],
)
def test_a_pruned_run_counts_only_under_the_same_pruning(
    sweep: SweepFolder, overrides: tuple[str, ...], same: bool
) -> None:
    base = ("prune.after=1", "prune.above=9", "objective=a")
    work = draft(sweep, "0")
    (work / "pruned.json").write_text(json.dumps({"why": "", "objective": "a", "after": 1.0, "above": 9.0}))
    sweep.publish(work, settings(*base), [])
    assert (sweep.find(settings(*base, *overrides), "0") is not None) == same


@given(st.sampled_from(["seed", "experiment.duration", "velocity_filter.window", "adaptation.gamma"]), st.data())
def test_different_runs_have_different_fingerprints(key: str, data: st.DataObject) -> None:
    one, other = data.draw(st.lists(st.integers(3, 99), min_size=2, max_size=2, unique=True))
    assert fingerprint(settings(f"{key}={one}")) == fingerprint(settings(f"{key}={one}", "resume=true"))
    assert fingerprint(settings(f"{key}={one}")) != fingerprint(settings(f"{key}={other}"))


def test_a_failed_job_is_kept_apart_until_it_ends_well(sweep: SweepFolder) -> None:
    failed = sweep.fail(draft(sweep, "10"), ["seed=1"], "no memory")
    sweep.fail(draft(sweep, "2"), ["seed=2"], "no time")
    assert failed.folder.name == "10.failed" and not list(sweep.finished())
    assert [(f.folder.name, f.why) for f in sweep.failures()] == [("2.failed", "no time"), ("10.failed", "no memory")]
    sweep.fail(draft(sweep, "10"), ["seed=1"], "no memory again")
    assert sweep.failures()[1].why == "no memory again"
    sweep.publish(draft(sweep, "10"), settings(), ["seed=1"])
    assert [f.folder.name for f in sweep.failures()] == ["2.failed"]


def test_a_job_that_meets_a_full_disk_is_named_and_costs_no_other(
    sweep: SweepFolder, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setattr(logging, "raiseExceptions", True)  # the job sets it
    plan = Plan(2, frozenset({"seed"}), [["seed=1"], ["seed=2"]])
    sweep.publish(draft(sweep, "0"), settings("seed=1"), ["seed=1"])
    work = draft(sweep, "1")

    def full(*_: object) -> None:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    with monkeypatch.context() as disk:
        disk.setattr(os, "fsync", full)
        assert run_job(raw("experiment=kinematic", "seed=2"), work, ["seed=2"], "simulate.log") == math.inf
    said = [f"{work / name} cannot be written: No space left on device" for name in ("config.yaml", "failure.json")]
    assert [record.getMessage() for record in caplog.records] == said and "Traceback" not in caplog.text
    assert [failure.folder.name for failure in sweep.failures()] == ["1.failed"] and not list(sweep.drafts())
    assert OpenSweep(sweep, plan, None, SweepBars(sweep, 2), ended=True).close() == 1
    assert "failed: 1.failed, seed=2: for a reason that could not be recorded" in caplog.text
    assert "not finished" not in caplog.text and (sweep.path / "0" / "job.json").exists()


def test_clearing_takes_what_is_not_finished_and_nothing_else(sweep: SweepFolder) -> None:
    place = sweep.publish(draft(sweep, "0"), settings(), [])
    draft(sweep, "1")
    sweep.fail(draft(sweep, "2"), [], "")
    (sweep.path / "multirun.yaml").write_text("")
    sweep.clear()
    assert (
        sorted(path.name for path in sweep.path.iterdir()) == ["0", "multirun.yaml"] and (place / "job.json").exists()
    )


@pytest.mark.parametrize("name", ["0", ".0.draft", ".0.x.draft", "0.1.draft"])
def test_a_draft_must_say_its_jobs_name(name: str) -> None:
    with pytest.raises(ConfigError, match=r"hydra\.sweep\.subdir"):
        job_name(Path(name))
    assert job_name(Path(".gamma=1.5,K=2.20260101.draft")) == "gamma=1.5,K=2"


@pytest.mark.parametrize(
    "content", ["{", "[]", "{}", '{"overrides": 3, "fingerprint": ""}', "[" * 9999, "9" * 9999, "\xff"]
)
def test_a_broken_record_is_named_and_costs_its_job_alone(
    content: str, sweep: SweepFolder, caplog: pytest.LogCaptureFixture
) -> None:
    for name, seed in (("0", "1"), ("1", "2")):
        sweep.publish(draft(sweep, name), settings(f"seed={seed}"), [f"seed={seed}"])
    (sweep.path / "0" / "job.json").write_text(content, encoding="latin-1")
    assert sweep.find(settings("seed=1"), "0") is None and sweep.find(settings("seed=2"), "0") == sweep.path / "1"
    assert f"{sweep.path / '0'} counts for nothing: " in caplog.text
    caplog.clear()
    plan = Plan(2, frozenset({"seed"}), [["seed=1"], ["seed=2"]])
    (sweep.path / "1" / "pruned.json").write_text(content, encoding="latin-1")
    assert OpenSweep(sweep, plan, "a", SweepBars(sweep, 2), True).close() == 1
    assert "not finished: seed=1" in caplog.text and "not finished: seed=2" not in caplog.text
