"""The report command on real runs: what it writes, prints and refuses."""

from __future__ import annotations

import csv
import json
import shutil
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from apcc_torch.errors import DataError
from apcc_torch.experiments import kinematic, redrawing
from apcc_torch.report import __main__ as program
from apcc_torch.report import animation, run_table
from apcc_torch.report.backbone_drawing import Snapshots
from apcc_torch.simulation.kinematic import KinematicLog

WriteRun = Callable[..., Path]


@pytest.fixture
def runs(real_runs: Path, tmp_path: Path) -> Path:
    return shutil.copytree(real_runs, tmp_path / "runs")


def page_data(path: Path) -> dict[str, object]:
    text = path.read_text(encoding="utf-8")
    start = text.index('id="data">') + len('id="data">')
    data: dict[str, object] = json.loads(text[start : text.index("</script>", start)])
    return data


@pytest.mark.parametrize("instants", [600, 8])
def test_the_film_shows_the_run(
    real_runs: Path, monkeypatch: pytest.MonkeyPatch, tmp_path: Path, instants: int
) -> None:
    filmed: dict[str, Any] = {}

    def film(path: Path, shots: Snapshots, readouts: dict[str, torch.Tensor], max_frames: int, warning: str) -> None:
        filmed.update(shots=shots, readouts=readouts, warning=warning)

    monkeypatch.setattr(kinematic, "save_animation", film)
    monkeypatch.setattr(kinematic, "INSTANTS", instants)
    redrawing.draw_anew(real_runs / "kinematic" / "1", tmp_path, True, True)
    _, arrays = redrawing.load_run(real_runs / "kinematic" / "1")
    assert filmed["warning"] is None
    # A short run is shown whole, a long one thinned, its last instant included.
    kept = slice(0, None) if instants == 600 else slice(2, None, 3)
    assert len(arrays["time"]) == 21 and filmed["shots"].time.tolist() == arrays["time"][kept].tolist()
    # The drawn arm ends where the run's tip was.
    torch.testing.assert_close(filmed["shots"].true_points[:, -1], arrays["x"][kept, 0])
    gap = 1e3 * (arrays["x_d"] - arrays["x"])[kept, 0].norm(dim=-1)
    torch.testing.assert_close(filmed["readouts"]["end-effector error (mm)"], gap)
    assert sorted(path.name for path in (tmp_path / "figures").iterdir()) == [f"figure_{k}.png" for k in (7, 8, 9)]


def test_a_dynamic_run_is_drawn_with_its_film(real_runs: Path, tmp_path: Path) -> None:
    redrawing.draw_anew(real_runs / "dynamic_single" / "0", tmp_path, True, True)
    names = {path.stem for path in (tmp_path / "figures").iterdir()}
    assert {"stroboscopic", "shape_error", "parameters", "sensors", "animation"} <= names


def test_only_so_many_runs_are_drawn_anew(runs: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    asked: list[Path] = []
    monkeypatch.setattr(program, "illustrate", lambda folder, filmed: asked.append(folder) or [])
    found = program.collect([runs]).runs
    (runs / "kinematic" / "1" / "figures").mkdir()
    (runs / "kinematic" / "1" / "figures" / "figure_7.png").write_bytes(b"")
    order = [0, 1, 2]
    program.illustrate_all(found, order, 24, 0, fresh=1)
    assert asked == [runs / "dynamic_single" / "0", runs / "kinematic" / "1"]


def test_the_command_writes_its_files_and_ranks(runs: Path, capsys: pytest.CaptureFixture[str]) -> None:
    program.main([str(runs), "--films", "1"])
    told = capsys.readouterr()
    assert told.out.startswith("3 complete of 3 runs, by shape_error_mean_mm") and "dynamic_single" in told.out
    assert told.err == "", "quiet without a terminal"
    with (runs / "runs.csv").open(newline="") as file:
        rows = {row["run"]: row for row in csv.DictReader(file)}
    assert list(rows) == ["dynamic_single/0", "kinematic/0", "kinematic/1"]
    for name, row in rows.items():
        metrics = json.loads((runs / name / "metrics.json").read_text())
        assert {key: float(row[key]) for key in metrics} == metrics
    data = page_data(runs / "report.html")
    assert set(data["pictures"]) == {"0", "1", "2"}  # type: ignore[call-overload]
    kinds = [picture["film"] for found in data["pictures"].values() for picture in found]  # type: ignore[attr-defined]
    assert kinds.count(True) == 1
    # Reading again finds the same runs, not its own output.
    program.main([str(runs), "--no-page"])
    assert "3 complete of 3 runs" in capsys.readouterr().out
    assert not list(runs.rglob("*.draft*"))


def test_without_ffmpeg_the_film_is_a_gif(runs: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(animation, "imageio_ffmpeg", None)
    monkeypatch.setattr(kinematic, "FILM_FRAMES", 3)
    *_, film = program.illustrate(runs / "kinematic" / "0", True)
    assert film.film and film.uri.startswith("data:image/gif;base64,R0lGOD")


def test_figures_of_the_run_are_used_as_they_are(runs: Path) -> None:
    folder = runs / "kinematic" / "0"
    redrawing.draw_anew(folder, folder, True, False)
    (folder / "trajectory.npz").unlink()
    assert [picture.name for picture in program.illustrate(folder, False)] == ["figure_7", "figure_8", "figure_9"]
    with pytest.raises(DataError, match=r"trajectory\.npz cannot be read"):
        program.illustrate(folder, True)


@pytest.mark.parametrize(
    ("file", "content", "named"),
    [
        ("trajectory.npz", b"cut short", "trajectory.npz cannot be read"),
        ("trajectory.npz", None, "trajectory.npz cannot be read"),
        ("config.yaml", b"unknown: {key: 1}", "config.yaml does not hold this version's settings"),
    ],
)
def test_a_run_that_cannot_be_drawn_is_told_and_the_others_go_on(
    runs: Path, capsys: pytest.CaptureFixture[str], file: str, content: bytes | None, named: str
) -> None:
    shutil.rmtree(runs / "dynamic_single")  # takes long to draw
    target = runs / "kinematic" / "0" / file
    target.unlink() if content is None else target.write_bytes(content)
    program.main([str(runs), "--films", "0"])
    told = capsys.readouterr().err.strip().splitlines()
    assert len(told) == 1 and told[0].startswith("kinematic/0 is shown without figures") and named in told[0]
    data = page_data(runs / "report.html")
    assert set(data["pictures"]) == {"1"}  # type: ignore[call-overload]


@pytest.mark.parametrize(
    ("arrays", "named"),
    [({"time": np.zeros(3)}, "has no"), (dict.fromkeys((*KinematicLog._fields, "pi"), np.zeros(())), "tuple index")],
)
def test_arrays_that_do_not_fit_are_told(
    runs: Path, capsys: pytest.CaptureFixture[str], arrays: dict[str, np.ndarray], named: str
) -> None:
    folder = runs / "kinematic" / "0"
    np.savez(folder / "trajectory.npz", **arrays)  # type: ignore[arg-type]
    program.main([str(folder)])
    (told,) = capsys.readouterr().err.splitlines()
    assert told.startswith("0 is shown without figures: ") and named in told


def test_a_figure_that_fails_is_told_with_its_run_and_the_others_are_shown(
    runs: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    def fails(*_: object, **__: object) -> None:
        raise RuntimeError("no room")

    monkeypatch.setattr("apcc_torch.report.kinematic.parameter_figure", fails)
    monkeypatch.setattr(kinematic, "save_animation", fails)
    program.main([str(runs / "kinematic" / "0")])
    told = capsys.readouterr().err.splitlines()
    assert told == ["0: figure_8.png is not drawn: no room", "0: the film is not drawn: no room"]
    shown = page_data(runs / "kinematic" / "0" / "report.html")["pictures"]
    assert [picture["name"] for picture in shown["0"]] == ["figure_7", "figure_9"]  # type: ignore[call-overload, index]


def test_failed_runs_are_listed_even_if_none_is_complete(
    tmp_path: Path, write_run: WriteRun, capsys: pytest.CaptureFixture[str]
) -> None:
    write_run(tmp_path / "0", {"a": 1})
    (tmp_path / "0" / "simulate.log").write_text("[t][x][ERROR] - a must be 2\n")
    with pytest.raises(SystemExit) as stopped:
        program.main([str(tmp_path)])
    told = capsys.readouterr()
    assert stopped.value.code == 2 and "none is complete" in told.err and "0: failed, a must be 2" in told.out
    assert "failed" in (tmp_path / "runs.csv").read_text()


def test_without_pyarrow_there_is_no_parquet_and_a_line_says_so(
    runs: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(run_table, "pyarrow", None)
    program.main([str(runs), "--no-page", "--out", str(runs / "out")])
    told = capsys.readouterr().err.strip().splitlines()
    assert len(told) == 1 and "pyarrow" in told[0] and "apcc-torch[report]" in told[0]
    assert [path.name for path in (runs / "out").iterdir()] == ["runs.csv"]


def test_best_and_worst_runs_get_their_pictures_first() -> None:
    assert list(program.from_both_ends([7, 5, 3, 1, 9])) == [7, 9, 5, 1, 3]
    assert list(program.from_both_ends([7, 5])) == [7, 5] and list(program.from_both_ends([4])) == [4]
    assert list(program.from_both_ends([])) == []


@pytest.mark.parametrize(
    ("arguments", "named"),
    [
        (["nowhere"], "nowhere is not a folder"),
        (["RUNS", "--metric", "shape_error"], "such as"),
    ],
)
def test_what_cannot_be_done_ends_with_one_sentence(
    runs: Path, capsys: pytest.CaptureFixture[str], arguments: list[str], named: str
) -> None:
    with pytest.raises(SystemExit) as stopped:
        program.main([argument.replace("RUNS", str(runs)) for argument in arguments])
    told = capsys.readouterr().err
    assert stopped.value.code == 2 and named in told and len(told.strip().splitlines()) == 1


def test_help_teaches_without_hydra() -> None:
    code = "import sys; from apcc_torch.report.__main__ import main; sys.argv[1:] = ['--help']\ntry: main()\n"
    code += "finally: assert 'hydra' not in sys.modules"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False, timeout=120)
    assert done.returncode == 0, done.stderr
    for part in ("runs.csv", "runs.parquet", "report.html", "--metric", "examples:"):
        assert part in done.stdout
