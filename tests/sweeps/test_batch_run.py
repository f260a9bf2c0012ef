"""A batch is its points run one by one: the same numbers, failures named, nothing lost when it is killed."""

from __future__ import annotations

import csv
import itertools
import json
import os
import signal
import time
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest

from apcc_torch.composition.run_settings import SimulateSettings
from apcc_torch.composition.stacking import Point
from apcc_torch.errors import ApccError, ConfigError
from apcc_torch.experiments.run import run as run_one
from apcc_torch.sweeps import batch_chunk
from apcc_torch.sweeps import batch_run as batch
from commands import environment, simulate
from composed import changed
from started import Program

QUICK = ("controller.rate=50", "figures=false", "progress=false")
KINEMATIC = ("experiment.duration=0.2", *QUICK)
DYNAMIC = (
    *("experiment.duration=0.1", "plant.settle=0.1", "experiment.payloads=[0,0.5]", *QUICK),
    "experiment.setpoints=[[0.1,0,-0.5],[0,0.1,-0.5]]",
)


def product(experiment: str, base: Sequence[str], **axes: Sequence[str]) -> list[Point]:
    """Every combination; a key is written with __ for its dots."""
    keys = [key.replace("__", ".") for key in axes]
    return [
        Point(
            i,
            dict(zip(keys, values, strict=True)),
            changed(experiment, *base, *map("=".join, zip(keys, values, strict=True))),
        )
        for i, values in enumerate(itertools.product(*axes.values()))
    ]


def gains(experiment: str, base: Sequence[str], count: int) -> list[Point]:
    """So many points that differ in the controller's gain."""
    one = changed(experiment, *base)
    given = [one.changed(controller=one.controller.changed(K=float(k))) for k in range(1, count + 1)]
    return [Point(i, {"controller.K": str(i + 1)}, config) for i, config in enumerate(given)]


def table(folder: Path) -> list[dict[str, str]]:
    with (folder / "points.csv").open(newline="") as file:
        return list(csv.DictReader(file))


def test_no_cell_of_points_csv_is_a_formula() -> None:
    point = Point(0, {"experiment.name": "=1+1", "controller.K": "-0.5"}, base())
    text = batch.table([point], batch_chunk.ChunkResult({0: {"=metric": -1e-3}}, {}))
    assert text == "point,experiment.name,controller.K,'=metric\n0,'=1+1,-0.5,-0.001\n"


def base(*changes: str) -> SimulateSettings:
    return changed("kinematic", *KINEMATIC, "batch_workers=1", *changes)


@pytest.mark.parametrize(
    ("experiment", "settings", "axes"),
    [
        ("kinematic", KINEMATIC, {"velocity_filter__window": ("5", "9"), "adaptation__gain_scale": ("0.1", "1", "3")}),
        (
            "kinematic",
            (*KINEMATIC, "experiment.start_errors=2"),
            {"feedback__mode": ("pose", "position"), "feedback__angular_weight": ("0.1", "0.3"), "seed": ("1", "2")},
        ),
        (
            "kinematic",
            (*KINEMATIC, "state=exact"),
            {"arm__lengths": ("[0.1,0.25,0.25]", "[0.11,0.26,0.24]"), "bounds__upper": ("null", "[2,2,2]", "1.5")},
        ),
        (
            "dynamic_run_2",
            (*DYNAMIC, "sensors.position_noise=2e-4"),
            {
                "controller__K": ("1", "[2,1,1]"),
                "plant__pid__K_P": ("500", "750"),
                "plant__transmission__friction": ("0", "0.1"),
            },
        ),
        (
            "dynamic_run_1",
            DYNAMIC,
            {
                "arm__lengths": ("[0.1,0.25,0.25]", "[0.11,0.26,0.24]"),
                "arm__mass": ("1", "1.3"),
                "plant__arm__mass": ("0.9", "1.2"),
                "plant__arm__layout": ("coupled", "independent"),
            },
        ),
        (
            "robot_2",
            DYNAMIC,
            {
                "arm__sensors": ("[0.15,0.3,0.45]", "[0.1,0.25,0.44]"),
                "adaptation__time_constant": ("0.2", "0.4"),
            },
        ),
        (
            "dynamic_run_2",
            DYNAMIC,
            {
                "plant__arm__true_sensors": ("[0.1,0.35,0.6]", "[0.11,0.36,0.58]"),
                "arm__masses": ("[0.3,0.4,0.3]", "[0.2,0.5,0.3]"),
                "bounds__lower": ("0.5", "[along,0.6,0.7]"),
            },
        ),
        (
            "dynamic_run_2",
            (*DYNAMIC, "plant=rod", "plant.refine=1", "plant.settle=0", "plant.events.taken_at=0.02"),
            {"plant__places__tendons": ("0.0", "0.002"), "plant__events__taken": ("0.0", "0.2")},
        ),
        ("tracking", (*DYNAMIC[:-1], "experiment.setpoints=null"), {"experiment__omega": ("1", "2")}),
    ],
)
def test_each_point_is_the_run_of_its_settings(
    tmp_path: Path, experiment: str, settings: tuple[str, ...], axes: dict[str, tuple[str, ...]]
) -> None:
    points = product(experiment, settings, **axes)
    batch.run(base(), points, tmp_path / "batch")
    found = table(tmp_path / "batch")
    assert [row["point"] for row in found] == [str(point.number) for point in points]
    for point, row in zip(points, found, strict=True):
        alone = run_one(point.config, tmp_path / "alone")
        assert {key: row[key] for key in point.settings} == point.settings
        assert set(row) == {"point", *point.settings, *alone}
        numbers = {name: float(row[name]) for name in alone if name != "wall_s"}
        assert numbers == pytest.approx({name: alone[name] for name in numbers}, rel=1e-9, abs=1e-9)


def test_the_best_and_the_worst_keep_a_run_folder(tmp_path: Path) -> None:
    points = product("kinematic", KINEMATIC, adaptation__gain_scale=("0.1", "1", "0.3", "2", "0.2"))
    found = batch.run(base("batch_kept=3", "objective=pi_error_end_max_mm", "figures=true"), points, tmp_path)
    errors = {row["point"]: float(row["pi_error_end_max_mm"]) for row in table(tmp_path)}
    order = sorted(errors, key=lambda point: errors[point])
    assert {entry.name for entry in (tmp_path / "points").iterdir()} == {order[0], order[1], order[-1]}
    assert found["best_point"] == int(order[0]) and found["pi_error_end_max_mm"] == errors[order[0]]
    assert (found["points"], found["failed_points"], found["diverged_points"]) == (5, 0, 0)
    best = tmp_path / "points" / order[0]
    assert json.loads((best / "metrics.json").read_text())["pi_error_end_max_mm"] == errors[order[0]]
    assert (
        f"gain_scale: {float(points[int(order[0])].settings['adaptation.gain_scale'])}"
        in (best / "config.yaml").read_text()
    )
    assert (best / "versions.json").is_file() and list((best / "figures").glob("*.png"))
    run_one(points[int(order[0])].config, tmp_path / "alone")
    with np.load(best / "trajectory.npz") as kept, np.load(tmp_path / "alone" / "trajectory.npz") as alone:
        assert set(kept) == set(alone)
        for name in kept:
            np.testing.assert_allclose(kept[name], alone[name], rtol=1e-9, atol=1e-12)
    assert json.loads((tmp_path / "metrics.json").read_text()) == found
    assert not list(tmp_path.glob(".batch*"))


def test_a_point_that_is_refused_is_named_and_the_others_go_on(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    points = product("kinematic", KINEMATIC, bounds__lower=("0.5", "1.5", "0.6"), controller__K=("1", "2"))
    found = batch.run(base(), points, tmp_path)
    assert (found["points"], found["failed_points"]) == (6, 2)
    rows = table(tmp_path)
    assert [row["point"] for row in rows if row["rows"] == ""] == ["2", "3"] and rows[2]["bounds.lower"] == "1.5"
    assert "point 2 failed, bounds.lower=1.5 controller.K=1: lower must be below upper" in caplog.text
    with pytest.raises(ConfigError, match="no point could be run; the first one: lower must be below upper"):
        batch.run(base(), points[2:4], tmp_path / "none")


def test_a_point_that_diverges_is_last(tmp_path: Path) -> None:
    points = product("kinematic", KINEMATIC, controller__K=("1", "1e6"))
    found = batch.run(base(), points, tmp_path)
    assert (found["diverged_points"], found["best_point"]) == (1, 0)


def test_chunks_fit_into_memory_and_are_shared_out() -> None:
    points = gains("kinematic", KINEMATIC, 200)
    rows, mib = batch.point_mib(points[0].config)
    assert rows == 1
    few = list(batch.chunks(points, base(f"batch_memory_mib={int(20 * mib) + 1}")))
    assert max(map(len, few)) <= 20 * (1 + 1 / mib) and [p for chunk in few for p in chunk] == points
    shared = list(batch.chunks(points, base("batch_workers=2")))
    assert [len(chunk) for chunk in shared] == [100, 100]
    assert len(list(batch.chunks(points[:9], base("batch_workers=2")))) == 1
    many = gains("dynamic_run_2", (), 40)
    assert batch.point_mib(many[0].config)[0] == 30
    assert max(map(len, batch.chunks(many, base()))) <= batch.FASTEST_ROWS // 30


def test_resume_computes_only_what_is_missing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    points = product("kinematic", KINEMATIC, controller__K=("1", "2", "3"), feedback__mode=("pose", "position"))
    done: list[int] = []
    compute = batch_chunk.compute

    def breaks_off(task: batch_chunk.Task, tell: batch_chunk.Tell) -> None:
        if done:
            raise KeyboardInterrupt
        done.extend(point.number for point in task.points)
        compute(task, tell)

    monkeypatch.setattr(batch, "compute", breaks_off)
    with pytest.raises(KeyboardInterrupt):
        batch.run(base(), points, tmp_path)
    assert done == [0, 2, 4] and not (tmp_path / "metrics.json").exists() and not (tmp_path / "points.csv").exists()
    (parts,) = tmp_path.glob(".batch_*")
    (parts / "from_9.json.tmp").write_text("{")
    done.clear()
    again: list[int] = []

    def noted(task: batch_chunk.Task, tell: batch_chunk.Tell) -> None:
        again.extend(point.number for point in task.points)
        compute(task, tell)

    monkeypatch.setattr(batch, "compute", noted)
    batch.run(base("resume=true"), points, tmp_path)
    assert again == [1, 3, 5]
    batch.run(base(), points, tmp_path / "whole")
    rows, whole = table(tmp_path), table(tmp_path / "whole")
    assert [{**row, "wall_s": ""} for row in rows] == [{**row, "wall_s": ""} for row in whole]


def test_chunks_of_other_settings_are_not_resumed(tmp_path: Path) -> None:
    points = product("kinematic", KINEMATIC, controller__K=("1", "2"))
    others = product("kinematic", (*KINEMATIC, "controller.epsilon=0.1"), controller__K=("1", "2"))
    one, other = base(), base("controller.epsilon=0.1")
    assert batch.parts_folder(one, points, tmp_path) == batch.parts_folder(base("resume=true"), points, tmp_path)
    assert batch.parts_folder(one, points, tmp_path) != batch.parts_folder(other, others, tmp_path)
    assert batch.parts_folder(one, points, tmp_path) != batch.parts_folder(one, points[:1], tmp_path)
    draft = tmp_path / ".3.1.draft"
    assert batch.parts_folder(one, points, draft).parent == tmp_path


@pytest.mark.parametrize(
    ("change", "named"),
    [("batch_kept=-1", "batch_kept"), ("batch_memory_mib=0", "batch_memory"), ("batch_workers=0", "batch_workers"),
     ("prune.after=0.1", r"prune\.after"), ("objective=speed", "objective")],
)  # fmt: skip
def test_a_setting_without_meaning_is_named(tmp_path: Path, change: str, named: str) -> None:
    with pytest.raises(ApccError, match=named):
        batch.run(base(change), product("kinematic", KINEMATIC, controller__K=("1",)), tmp_path)
    assert not (tmp_path / "metrics.json").exists()


def test_a_replay_is_no_batch(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"experiment\.kind of a batch must be one of dynamic, kinematic"):
        batch.run(base(), product("replay", (), seed=("1",)), tmp_path)


def test_killed_and_resumed_nothing_is_lost(tmp_path: Path) -> None:
    """The program as a user runs it, over two processes, killed after its first chunk."""
    words = [
        *(f"hydra.run.dir={tmp_path / 'run'}", "experiment=kinematic"),
        *("experiment.duration=0.4", "figures=false", "batch_kept=2", "batch_memory_mib=8", "--batch"),
        *("controller.K=range(1,13)", "feedback=pose,position"),
    ]
    with Program("apcc_torch.simulate", words, tmp_path, environment(), session=True) as process:
        deadline = time.monotonic() + 120
        while not list(tmp_path.glob("run/.batch_*/from_*.json")) and time.monotonic() < deadline:
            time.sleep(0.05)
        os.killpg(process.pid, signal.SIGKILL)
    finished = {path.name: path.read_bytes() for path in tmp_path.glob("run/.batch_*/from_*.json")}
    assert finished and not (tmp_path / "run" / "metrics.json").exists()
    done = simulate(tmp_path, *words, "resume=true")
    assert done.returncode == 0, done.stderr
    rows = table(tmp_path / "run")
    assert [int(row["point"]) for row in rows] == list(range(24)) and "are there already" in done.stdout
    kept = {i: metrics for content in finished.values() for i, metrics in json.loads(content)["metrics"].items()}
    assert all(float(rows[int(i)]["wall_s"]) == metrics["wall_s"] for i, metrics in kept.items())


@pytest.mark.parametrize("where", ["copytree", "draw"])
def test_numbers_are_there_before_the_kept_points_are(
    where: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    points = product("kinematic", KINEMATIC, controller__K=("1", "2", "3"))

    def stops(*_: object) -> None:
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr(batch.shutil if where == "copytree" else batch, where, stops)
        with pytest.raises(KeyboardInterrupt):
            batch.run(base("figures=true", "batch_kept=2"), points, tmp_path)
    assert len(table(tmp_path)) == 3
    assert (tmp_path / "metrics.json").exists() == (where == "draw")
    kept = list(tmp_path.glob("points/*/metrics.json"))
    assert len(kept) == (2 if where == "draw" else 0) and bool(list(tmp_path.glob(".batch_*"))) != bool(kept)
    if where == "copytree":
        monkeypatch.setattr(batch, "compute", stops)
        batch.run(base("resume=true", "batch_kept=2"), points, tmp_path)
        assert len(list(tmp_path.glob("points/*/metrics.json"))) == 2


@pytest.mark.parametrize(
    "content", ["{", "[]", '{"metrics": {"0": 3}, "failed": {}}', '{"metrics": {"0": {"a": "b"}}, "failed": {}}']
)
def test_a_damaged_chunk_is_run_again(content: str, tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    points = product("kinematic", KINEMATIC, controller__K=("1",))
    parts = batch.parts_folder(base("resume=true"), points, tmp_path)
    parts.mkdir()
    (parts / "from_0.json").write_text(content)
    assert batch.run(base("resume=true"), points, tmp_path)["points"] == 1
    assert "from_0.json" in caplog.text and "its points are run again" in caplog.text
