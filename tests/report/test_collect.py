"""Every run below a folder is found once, with what became of it; nothing that is broken stops the others."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import pytest

from apcc_torch.errors import DataError
from apcc_torch.report.collect import collect
from apcc_torch.report.run_record import Run

WriteRun = Callable[..., Path]
SETTINGS = {"gain": {"scale": 0.1}, "seed": 0}


def by_name(folder: Path) -> dict[str, Run]:
    runs = collect([folder]).runs
    found = {run.name: run for run in runs}
    assert len(found) == len(runs)
    return found


def test_a_complete_run_has_its_settings_metrics_and_folder(tmp_path: Path, write_run: WriteRun) -> None:
    folder = write_run(tmp_path / "a", SETTINGS, {"m_mm": 1.5}, ["gain.scale=0.1"])
    (run,) = collect([tmp_path]).runs
    assert (run.name, run.status, run.folder, run.note) == ("a", "complete", folder, "")
    assert run.settings == {"gain.scale": 0.1, "seed": 0} and run.metrics == {"m_mm": 1.5}
    assert run.overrides == {"gain.scale": "0.1"} and run.versions["torch"] == "1.2"
    # The folder itself, given alone, keeps its name.
    assert collect([folder]).runs[0].name == "a"


def test_a_run_with_diverged_rows_says_so(tmp_path: Path, write_run: WriteRun) -> None:
    write_run(tmp_path / "a", SETTINGS, {"m": 1.0, "rows": 30.0, "diverged_rows": 2.0})
    write_run(tmp_path / "b", SETTINGS, {"m": 1.0, "rows": 30.0, "diverged_rows": 0.0})
    assert {name: run.note for name, run in by_name(tmp_path).items()} == {"a": "2 of 30 rows diverged", "b": ""}


def test_what_is_not_complete_is_listed_with_why(tmp_path: Path, write_run: WriteRun) -> None:
    write_run(tmp_path / "0", SETTINGS, {"m": 1.0})
    write_run(tmp_path / "1", SETTINGS)
    write_run(tmp_path / "2", SETTINGS)
    (tmp_path / "2" / "simulate.log").write_text("[2026][x][INFO] - hello\n[2026][x][ERROR] - gain must be positive\n")
    write_run(tmp_path / "3", None, None, ["gain.scale=0.7", "experiment=x"])
    write_run(tmp_path / "4.failed", SETTINGS)
    (tmp_path / "4.failed" / "failure.json").write_text(json.dumps({"why": "killed by SIGKILL"}))
    write_run(tmp_path / ".5.123.draft", SETTINGS)
    write_run(tmp_path / ".0.99.draft", SETTINGS)  # of a job that has ended well since
    write_run(tmp_path / ".abc.discarded", SETTINGS)
    write_run(tmp_path / "6", SETTINGS)
    (tmp_path / "6" / "pruned.json").write_text(json.dumps({"why": "a row diverged"}))
    found = by_name(tmp_path)
    assert {name: run.status for name, run in found.items()} == {
        **{"0": "complete", "1": "unfinished", "2": "failed", "3": "unfinished"},
        **{"4": "failed", "5": "unfinished", "6": "pruned"},
    }
    assert found["2"].note == "gain must be positive" and found["4"].note == "killed by SIGKILL"
    assert found["6"].note == "a row diverged" and "killed, or still runs" in found["1"].note
    # Before its settings were written the command line says what the run was to be.
    assert found["3"].settings == {"gain.scale": 0.7}


@pytest.mark.parametrize(
    ("file", "content", "named"),
    [
        ("metrics.json", '{"a": 1', "metrics.json cannot be read"),
        ("metrics.json", '{"a": "x"}', "metrics.json must hold numbers, but a is 'x'"),
        ("metrics.json", "[1]", "metrics.json must hold values by name"),
        ("config.yaml", "a: [1", "config.yaml cannot be read"),
        ("config.yaml", "- 1", "config.yaml must hold settings by name"),
        ("versions.json", "", "versions.json cannot be read"),
        (".hydra/overrides.yaml", "a: 1", "overrides.yaml must hold a list"),
        ("failure.json", "{", ""),  # of no account once the metrics are there
    ],
)
def test_a_broken_folder_is_named_and_the_others_go_on(
    tmp_path: Path, write_run: WriteRun, file: str, content: str, named: str
) -> None:
    for name in ("a", "b"):
        write_run(tmp_path / name, SETTINGS, {"m": 1.0})
    (tmp_path / "a" / file).write_text(content)
    broken, whole = collect([tmp_path]).runs
    assert whole.status == "complete" and whole.metrics == {"m": 1.0}
    assert broken.status == ("broken" if named else "complete") and named in broken.note
    assert "\n" not in broken.note


def test_a_run_without_its_trajectory_counts_and_says_so(tmp_path: Path, write_run: WriteRun) -> None:
    (write_run(tmp_path / "a", SETTINGS, {"m": 1.0}) / "trajectory.npz").unlink()
    (run,) = collect([tmp_path]).runs
    assert run.status == "complete" and run.note == "trajectory.npz is missing"


def test_jobs_come_in_the_order_of_their_numbers(tmp_path: Path, write_run: WriteRun) -> None:
    for k in (10, 2, 1, 0):
        write_run(tmp_path / "sweep" / str(k), SETTINGS, {"m": 1.0})
    write_run(tmp_path / "other", SETTINGS, {"m": 1.0})
    assert list(by_name(tmp_path)) == ["other", *(f"sweep/{k}" for k in (0, 1, 2, 10))]
    # Two folders share a parent; a folder inside another is not counted twice.
    both = collect([tmp_path / "sweep", tmp_path / "other", tmp_path / "sweep" / "2"]).runs
    assert [run.name for run in both] == [*(f"sweep/{k}" for k in (0, 1, 2, 10)), "other"]


def test_points_of_a_batch_are_runs(tmp_path: Path, write_run: WriteRun) -> None:
    folder = write_run(tmp_path / "batch", SETTINGS, {"m": 9.0, "wall_s": 1.0}, ["batch=x"])
    write_run(folder / "points" / "1", SETTINGS, {"m": 2.0})
    (folder / "points.csv").write_text("point,gain.scale,seed,m,n\n0,0.1,3,1.5,\n1,1e-3,4,nan,2\n")
    write_run(tmp_path / "single", SETTINGS, {"m": 3.0})
    found = by_name(tmp_path)
    assert list(found) == ["batch/points/0", "batch/points/1", "single"]
    first, second = found["batch/points/0"], found["batch/points/1"]
    assert dict(first.settings) == {"gain.scale": 0.1, "seed": 3} and second.settings["gain.scale"] == 1e-3
    assert first.metrics == {"m": 1.5} and second.metrics["n"] == 2.0 and second.metrics["m"] != second.metrics["m"]
    assert first.own == ("gain.scale", "seed") and first.folder is None and second.folder == folder / "points" / "1"
    assert [run.name for run in collect([folder]).runs] == ["points/0", "points/1"]
    (folder / "metrics.json").unlink()
    assert by_name(tmp_path)["batch"].status == "unfinished"


def test_a_point_may_have_failed_and_may_sweep_a_group(tmp_path: Path, write_run: WriteRun) -> None:
    folder = write_run(tmp_path / "batch", SETTINGS, {"m": 9.0})
    (folder / "points.csv").write_text("point,gain,seed,m\n0,high,3,1.5\n1,low,4,\n")
    whole, failed = collect([folder]).runs
    assert (whole.status, whole.settings["gain"], whole.metrics) == ("complete", "high", {"m": 1.5})
    assert (failed.status, failed.settings["gain"], failed.metrics) == (
        "failed",
        "low",
        {},
    ) and "no metrics" in failed.note


@pytest.mark.parametrize(
    ("text", "named"),
    [
        ("a,b\n1,2\n", "a column named point"),
        ("point,m\n0,1\n1\n", "2 entries in line 3, got 1"),
        ("point,m\n0,x\n", "a number for m in line 2, got 'x'"),
        ("", "a column named point"),
    ],
)
def test_a_broken_table_of_points_is_one_broken_run(tmp_path: Path, write_run: WriteRun, text: str, named: str) -> None:
    folder = write_run(tmp_path / "batch", SETTINGS, {"m": 9.0})
    (folder / "points.csv").write_text(text)
    (run,) = collect([tmp_path]).runs
    assert run.status == "broken" and named in run.note and run.metrics == {}


def test_a_benchmark_is_passed_over_and_named(tmp_path: Path, write_run: WriteRun) -> None:
    write_run(tmp_path / "a", SETTINGS, {"m": 1.0})
    (write_run(tmp_path / "paper", {"benchmark": {}}) / "table.json").write_text("{}")
    collection = collect([tmp_path])
    assert [run.name for run in collection.runs] == ["a"]
    assert len(collection.skipped) == 1 and collection.skipped[0].startswith("paper is passed over")


def test_nothing_to_report_is_an_error(tmp_path: Path) -> None:
    with pytest.raises(DataError, match="at least one run"):
        collect([tmp_path])
    with pytest.raises(DataError, match="is not a folder"):
        collect([tmp_path / "none"])
