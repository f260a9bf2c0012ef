"""Folders of runs that anybody may have filled: each damaged file is its own run's failure, and the report is made."""

from __future__ import annotations

import csv
import json
import os
import shutil
from collections.abc import Callable
from pathlib import Path
from random import Random

import numpy as np
import pytest

from apcc_torch.report import __main__ as program
from apcc_torch.report.collect import collect
from odd_values import odd_mapping, odd_text, odd_value, seeds

WriteRun = Callable[..., Path]
SETTINGS = {"gain": {"scale": 0.1}, "seed": 0}
METRICS = {"m_mm": 1.5, "wall_s": 1.0}
MUTATIONS = 100
"""Damaged folders that are tried where nobody asks for more."""
NAMES = (
    "b", "b b'\"", "b\nc", "b\udcff", "ü\U0001f916", "=1+1", "\x1b[2J", "-b", "$b %s", "<b>", ".failed", "x" * 200,
    "b.failed",
)  # fmt: skip
FILES = (
    "metrics.json", "config.yaml", ".hydra/overrides.yaml", "versions.json", "failure.json", "points.csv",
    "figures/a.png",
)  # fmt: skip


def odd_file(path: Path, random: Random) -> None:
    """Puts something else in a file's place."""
    if os.path.lexists(path):
        path.unlink()
    match random.randrange(8):
        case 0:
            path.mkdir()
        case 1:
            path.symlink_to(random.choice((".", "none", path.name, "/dev/zero")))
        case 2:
            os.mkfifo(path)
        case 3:
            path.write_bytes(random.choice((b"", b"\xff\xfe", random.randbytes(50), b"[" * 100_000, b"- " * 50_000)))
        case 4:
            bomb = "\n".join(f"k{k}: &k{k} [{', '.join([f'*k{k - 1}'] * 9) if k else 'x'}]" for k in range(9))
            path.write_text(bomb)
        case 5:
            path.write_text(
                "point,m_mm,gain.scale\n" + ",".join(json.dumps(odd_value(random)) for _ in range(3)) + "\n"
            )
        case 6:
            text = f"- {odd_text(random)}={odd_text(random)}\n- a.b: {odd_text(random)}\n"
            path.write_text(text, encoding="utf-8", errors="surrogatepass")
        case _:
            path.write_bytes(odd_mapping({**SETTINGS, **METRICS, "why": "x"}, random))


def damage(folder: Path, random: Random) -> None:
    """Damages a run's folder in one or two places."""
    for name in random.sample(FILES, random.choice((1, 1, 2))):
        (folder / name).parent.mkdir(exist_ok=True)
        odd_file(folder / name, random)
    if random.random() < 0.2:
        (folder / "metrics.json").unlink() if os.path.isfile(folder / "metrics.json") else None
    if random.random() < 0.1:
        (folder / "run.log").write_bytes(b"[x][ERROR] - \x1b[2J\xff" + odd_text(random).encode("utf-8", "replace"))


def test_whatever_is_in_a_folder_the_others_are_reported(
    tmp_path: Path, write_run: WriteRun, capsys: pytest.CaptureFixture[str]
) -> None:
    runs = tmp_path / "all"
    whole = write_run(runs / "a", SETTINGS, METRICS)
    for seed in seeds(MUTATIONS):
        random = Random(seed)
        name = random.choice(NAMES)
        write_run(runs / name, SETTINGS, METRICS, ["gain.scale=0.1"])
        damage(runs / name, random)
        arguments = [str(runs), "--draw", "0", "--films", "0"] + ["--no-page"] * (seed % 5 > 0)
        try:
            program.main(arguments)
        except (Exception, SystemExit) as error:
            raise AssertionError(f"seed {seed}: {name!r}") from error
        told = capsys.readouterr()
        assert all(c.isprintable() or c == "\n" for c in told.out + told.err), seed
        with (runs / "runs.csv").open(newline="", encoding="utf-8") as file:
            rows = list(csv.reader(file))
        cells = dict(zip(rows[0], next(row for row in rows if row[0] == "a"), strict=True))
        # A damaged run may sweep a key of the metric's name; the table then says which is which.
        metric = cells.get("m_mm (metric)", cells["m_mm"])
        assert cells["status"] == "complete" and metric and float(metric) == 1.5, (seed, rows)
        assert len(rows) > 2 or name == ".failed" or seed % 5 == 0, seed
        if "--no-page" not in arguments:
            page = (runs / "report.html").read_text(encoding="utf-8")
            assert json.loads(page.partition('id="data">')[2].partition("</script>")[0])["columns"], seed
        shutil.rmtree(runs / name)
    assert [run.folder for run in collect([runs]).runs] == [whole]


@pytest.mark.parametrize("to", [".", "..", "/", "../all"])
def test_links_in_circles_end(tmp_path: Path, write_run: WriteRun, to: str) -> None:
    runs = tmp_path / "all"
    write_run(runs / "sweep" / "0", SETTINGS, METRICS)
    (runs / "sweep" / "again").symlink_to(to)
    (runs / "around").symlink_to(runs)
    assert [run.name for run in collect([runs]).runs] == ["sweep/0"]


def test_a_link_to_runs_of_elsewhere_is_followed(tmp_path: Path, write_run: WriteRun) -> None:
    write_run(tmp_path / "store" / "7", SETTINGS, METRICS)
    runs = tmp_path / "all"
    write_run(runs / "1", SETTINGS, METRICS)
    for name in ("0", "2"):
        (runs / name).symlink_to(tmp_path / "store" / "7")
    assert [run.name for run in collect([runs]).runs] == ["0", "1"]


def test_a_folder_that_cannot_be_read_is_passed_over(
    tmp_path: Path, write_run: WriteRun, monkeypatch: pytest.MonkeyPatch
) -> None:
    write_run(tmp_path / "a", SETTINGS, METRICS)
    (tmp_path / "b").mkdir()

    read = os.listdir

    def listed(folder: Path) -> list[str]:
        if folder.name == "b":
            raise PermissionError(13, "Permission denied")
        return read(folder)

    monkeypatch.setattr(os, "listdir", listed)
    found = collect([tmp_path])
    assert [run.name for run in found.runs] == ["a"] and found.skipped == ["b is passed over: Permission denied"]


@pytest.mark.parametrize(
    ("file", "content", "named"),
    [
        ("metrics.json", f'{{"a": {"9" * 400}}}', "metrics.json cannot be read: it holds a number of 400 characters"),
        ("metrics.json", "[" * 100_000, "metrics.json cannot be read: too many lists"),
        ("metrics.json", '{"a": true}', "metrics.json must hold numbers, but a is True"),
        ("metrics.json", '{"a": [1]}', "metrics.json must hold numbers, but a is a list"),
        ("metrics.json", b"\xff", "metrics.json cannot be read: it is not UTF-8 from byte 0 on"),
        ("config.yaml", "a: &a [1]\nb: *a", "config.yaml cannot be read: it refers to a part of itself"),
        ("config.yaml", "a: " + "[" * 150 + "]" * 150, "config.yaml cannot be read: over 100 lists or mappings"),
        ("config.yaml", "a: !!python/name:os.system", "config.yaml cannot be read: it names a type"),
        ("config.yaml", "a: 2026-13-45", "config.yaml cannot be read: month must be in 1..12"),
        ("config.yaml", "a: 1" + ":1" * 400, "config.yaml cannot be read: it holds a number of 801 characters"),
    ],
)
def test_a_file_without_bounds_is_its_runs_failure(
    tmp_path: Path, write_run: WriteRun, file: str, content: str | bytes, named: str
) -> None:
    for name in ("a", "b"):
        write_run(tmp_path / name, SETTINGS, METRICS)
    (tmp_path / "a" / file).write_bytes(content if isinstance(content, bytes) else content.encode())
    broken, whole = collect([tmp_path]).runs
    assert whole.status == "complete" and broken.status == "broken" and broken.note.startswith(named)


def test_metrics_that_are_not_finite_stay(tmp_path: Path, write_run: WriteRun) -> None:
    folder = write_run(tmp_path / "a", SETTINGS, METRICS)
    (folder / "metrics.json").write_text('{"a": NaN, "b": -Infinity, "c": 1e999}')
    (run,) = collect([tmp_path]).runs
    assert np.isnan(run.metrics["a"]) and run.metrics["b"] == -run.metrics["c"] == -np.inf


def test_a_folder_that_cannot_be_written_to_is_named(
    tmp_path: Path, write_run: WriteRun, capsys: pytest.CaptureFixture[str]
) -> None:
    write_run(tmp_path / "a", SETTINGS, METRICS)
    (tmp_path / "taken").write_text("")
    with pytest.raises(SystemExit) as stopped:
        program.main([str(tmp_path), "--out", str(tmp_path / "taken")])
    assert stopped.value.code == 2 and capsys.readouterr().err.count("\n") == 1
