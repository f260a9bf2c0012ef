"""The whole command on a recording that a Cosserat rod made, and what no method may see."""

from __future__ import annotations

import json
import subprocess
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from apcc_torch.composition.evaluate import recordings
from apcc_torch.composition.identify import parameters
from apcc_torch.errors import DataError
from apcc_torch.evaluation.frames import Frames
from apcc_torch.evaluation.leaderboard import evaluate
from apcc_torch.evaluation.learning import Linear
from apcc_torch.evaluation.method import Known, Method
from apcc_torch.evaluation.methods import METHODS
from apcc_torch.evaluation.tasks import Task, tasks_of
from apcc_torch.experiments.evaluation import limited
from apcc_torch.identification.series import Series
from commands import environment
from composed import composed_evaluate
from rod_recordings import write_recordings
from started import ran

MOTORS, FOLLOWED = "motors", "motors, load followed"


def _evaluate(folder: Path, *arguments: str) -> subprocess.CompletedProcess[str]:
    return ran("apcc_torch.evaluate", arguments, folder, environment())


def test_a_strangers_arm_from_the_command_line(tmp_path: Path) -> None:
    pytest.importorskip("sklearn")
    write_recordings(tmp_path)
    chosen = ["mean", "linear", "arm identified", "arm identified, payload followed", "most probable PCC"]
    chosen += ["most probable, arm identified", "most probable, rest learned"]
    words = ",".join(f"'{name}'" for name in chosen)
    done = _evaluate(tmp_path, "data=data.yaml", f"methods=[{words}]", "hydra.run.dir=out")
    assert done.returncode == 0, done.stdout + done.stderr
    out = tmp_path / "out"
    table = json.loads((out / "table.json").read_text())
    assert not table["failures"] and {m for task in table["tasks"].values() for m in task} == set(chosen)

    def tip(task: str, method: str, session: str = "empty", body: int = 2) -> float:
        found: float = table["tasks"][task][method]["sessions"][session][f"body_{body}"]["rms_mm"]
        return found

    # White noise of 0.1 mm a coordinate leaves 0.17 mm of distance.
    assert tip(MOTORS, "arm identified") < 0.5 < tip(MOTORS, "linear") < tip(MOTORS, "mean")
    assert tip(MOTORS, "arm identified", "loaded") > 2.0 * tip(FOLLOWED, "arm identified, payload followed", "loaded")
    assert tip(FOLLOWED, "arm identified, payload followed", "loaded") < 0.5
    with_motors, alone = (tip(f"body 2{told}", "most probable PCC", body=1) for told in (" and motors", ""))
    assert with_motors < 0.2 * alone
    for name in ("most probable, arm identified", "most probable, rest learned"):
        # The payload that nobody told is found from the one body that is shown.
        assert tip("body 2 and motors", name, "loaded", body=1) < 0.3 < tip(MOTORS, "arm identified", "loaded", body=1)
    for weighed in table["payload"]:
        assert weighed["low_g"] < weighed["true_g"] < weighed["high_g"]
    # The arm was identified empty, and of the loaded one its intervals do not speak.
    assert [(each["session"], each["body"]) for each in table["coverage"]] == [("empty", 1), ("empty", 2)]
    for each in table["coverage"]:
        assert 88.0 < each["folds"][0] <= 100.0 and 0.1 < each["half_width"] < 1.0
    assert [weighed["scale_from"] for weighed in table["payload"]] == [
        *("loaded", "the arm's file", "loaded, its training part"),
    ]
    assert len(list((out / "figures").glob("*.png"))) == len(table["tasks"])
    page = (out / "leaderboard.html").read_text()
    assert page.count("<img") == len(table["tasks"]) and "arm identified, payload followed" in page
    assert (out / "table.txt").read_text().strip() in done.stdout
    again = _evaluate(tmp_path, "data=data.yaml", "hydra.run.dir=out")
    assert again.returncode == 2 and "holds results" in again.stdout + again.stderr


@pytest.mark.parametrize("name", METHODS)
def test_every_method_answers_what_it_says(name: str, small: tuple[Known, Frames]) -> None:
    """On a few moments and after a step of a fit: finite, of the right shape, and near the arm."""
    pytest.importorskip("sklearn")
    known, frames = small
    train, test = frames.at(torch.arange(0, 40, 2)), frames.at(torch.arange(1, 40, 4))
    method = METHODS[name](known)
    method.fit(train)
    asked = [task for task in tasks_of(2, False) if method.answers(task)]
    assert asked or name == "PCC, best lengths in hindsight"  # no two bodies are shown
    for task in asked:
        seen = train if task.online else test if method.hindsight else None
        asked_of = test.at(test.past.seen) if task.ahead else test
        found = method.predict(asked_of.showing(task), task, seen)
        assert found.shape == asked_of.positions.shape
        assert float((found - asked_of.positions).norm(dim=-1).max()) < 0.15


@pytest.fixture(scope="module")
def small(tmp_path_factory: pytest.TempPathFactory) -> tuple[Known, Frames]:
    """What is known of the small arm, and 40 moments of its recording."""
    data = write_recordings(tmp_path_factory.mktemp("small"), count=40)
    settings = composed_evaluate(f"data={data}", "fit.steps=1", "fit.samples=10")
    sessions, rest = recordings(settings)
    blocks = parameters(settings)
    known = Known(settings.arm, blocks, blocks.holding(("rest_length",)), rest, settings.fit, 10, 0, lambda line: None)
    return known, sessions[0].frames


def _moments(k: int = 3) -> Frames:
    generator = torch.Generator().manual_seed(0)
    inputs, places = torch.randn(40, 2, generator=generator).double(), torch.randn(40, k, 3, generator=generator)
    turns = torch.eye(3).double().expand(40, k, 3, 3)
    series = Series(torch.arange(40).double(), inputs, places.double(), torch.zeros(40, dtype=torch.int64), "", turns)
    return Frames.of(series, history=3)


@pytest.mark.parametrize("task", tasks_of(3, True), ids=lambda task: task.name)
def test_what_is_not_shown_cannot_be_seen(task: Task) -> None:
    frames = _moments()
    shown = frames.showing(task)
    hidden = task.hidden(3)
    assert bool(shown.positions[:, list(hidden)].isnan().all()) and bool(shown.rotations[:, list(hidden)].isnan().all())
    assert bool(shown.positions[:, list(task.shown)].isfinite().all())
    assert bool(shown.rotations[:, list(task.shown)].isfinite().all()) == task.orientations or not task.shown
    assert bool(shown.inputs.isfinite().all()) == task.motors
    assert (
        bool(shown.past.positions[2:].isfinite().all()) == bool(shown.past.drive.history.isfinite().all()) == task.ahead
    )
    assert bool(frames.positions.isfinite().all()), "the recording itself stays as it is"


def test_the_past_is_of_the_same_movement() -> None:
    frames = _moments()
    groups = torch.arange(40) // 10
    series = Series(frames.times, frames.inputs, frames.positions, groups)
    found = Frames.of(series, history=3, travel=1.0)
    want = [n for n in range(40) if n % 10 > 1]
    assert found.past.seen.tolist() == want
    later = found.at(torch.tensor(want[3:20:4]))
    index = torch.tensor(want[3:20:4])
    for back in (1, 2):
        torch.testing.assert_close(later.past.positions[:, back - 1], frames.positions[index - back], rtol=0, atol=0)
    before = found.at(index - 1)
    for mine, theirs in zip(later.past.drive, before.drive, strict=True):
        torch.testing.assert_close(mine, theirs, rtol=0, atol=0)


def test_one_step_ahead_of_steady_motion() -> None:
    """Of bodies that move on evenly who keeps the speed is right; who stays is off by a step; regressions learn it."""
    pytest.importorskip("sklearn")
    times = torch.arange(60).double()
    way = torch.tensor([[0.001, 0.0, 0.002], [0.0, 0.003, 0.0]]).double()
    places = times[:, None, None] * way + 0.1
    series = Series(times, torch.stack((times, -times), -1), places, torch.zeros(60, dtype=torch.int64))
    frames, task = Frames.of(series, history=3), Task((), True, ahead=True)
    train, test = frames.at(torch.arange(40)), frames.at(torch.arange(40, 60))
    for name, off in (
        ("stays where it was", way.norm(dim=-1)),
        ("moves on as before", 0.0 * way[:, 0]),
        ("linear", 0.0 * way[:, 0]),
    ):
        method = METHODS[name](None)  # type: ignore[arg-type]
        assert method.answers(task)
        method.fit(train)
        found = method.predict(test.showing(task), task)
        torch.testing.assert_close((found - test.positions).norm(dim=-1), off.expand(20, 2), rtol=1e-6, atol=1e-8)


def test_tasks_of_an_arm() -> None:
    names = [task.name for task in tasks_of(3, False)]
    assert names == [
        *("motors", "motors, load followed", "motors, one step ahead", "bodies 2, 3", "bodies 2, 3 and motors"),
        *("bodies 1, 3", "bodies 1, 3 and motors", "bodies 1, 2", "bodies 1, 2 and motors", "body 3"),
        "body 3 and motors",
    ]
    assert [task.name for task in tasks_of(1, True)] == ["motors", "motors, load followed", "motors, one step ahead"]
    turned = [task.name for task in tasks_of(2, True) if task.orientations]
    assert turned == [
        *("body 2 and orientations", "body 2, orientations and motors"),
        *("body 1 and orientations", "body 1, orientations and motors"),
    ]


def test_linear_regression_is_least_squares_of_what_is_shown() -> None:
    pytest.importorskip("sklearn")
    frames = _moments()
    method = Linear.__new__(Linear)
    Linear.__init__(method, None)  # type: ignore[arg-type]
    train, test = frames.at(torch.arange(30)), frames.at(torch.arange(30, 40))
    task = Task((0, 2), True)
    method.fit(train)
    found = method.predict(test.showing(task), task).flatten(1).numpy()

    def features(part: Frames) -> np.ndarray[tuple[int, int], np.dtype[np.float64]]:
        return np.column_stack([part.positions[:, [0, 2]].flatten(1), part.inputs, np.ones(len(part))])

    want = features(test) @ np.linalg.lstsq(features(train), train.positions.flatten(1).numpy(), rcond=None)[0]
    np.testing.assert_allclose(found, want, rtol=1e-5, atol=1e-6)


def test_the_recorded_trunk_as_the_prototype(shared_data: Path) -> None:
    """Disk 2 from 1 and 3, disk 2 from 3, disk 3 from 1 and 2, each with the motors; 0 g and 200 g."""
    settings = composed_evaluate("data=trunk_payload", f"data_root={shared_data}")
    sessions, rest = recordings(settings)
    blocks = parameters(settings)
    known = Known(settings.arm, blocks, blocks, rest, settings.fit, 1, 0, lambda line: None)
    tasks = [Task((0, 2), True), Task((2,), True), Task((0, 1), True), Task((0, 2), False)]
    chosen = {"most probable PCC": METHODS["most probable PCC"]}

    def quietly(names: Sequence[str]) -> Sequence[str]:
        return names

    scores, failures = evaluate([known], sessions, settings.data.learned, tasks, chosen, 40, quietly)
    found = {(score.task, score.body, score.session): score.mean for score in scores}
    assert not failures
    for task, body, empty, loaded in [
        *(("bodies 1, 3 and motors", 2, 2.3, 2.5), ("body 3 and motors", 2, 3.1, 3.6)),
        *(("bodies 1, 2 and motors", 3, 5.7, 7.5), ("bodies 1, 3", 2, 6.2, 6.3)),
    ]:
        assert found[task, body, "0 g"] < empty and found[task, body, "200 g"] < loaded
    assert found["bodies 1, 3 and motors", 2, "0 g"] < 0.5 * found["bodies 1, 3", 2, "0 g"]


def test_orientations_and_motors_of_the_recorded_trunk(shared_data: Path) -> None:
    """What is learned weighs shown bodies, their orientations and motors well beyond what it was learned on."""
    settings = composed_evaluate("data=trunk", f"data_root={shared_data}")
    sessions, rest = recordings(settings)
    # So few moments and steps are enough for these bounds.
    blocks, fit = parameters(settings), replace(settings.fit, samples=60, steps=10, rounds=1)
    known = Known(settings.arm, blocks, blocks.holding(fit.geometric), rest, fit, fit.samples, 0, lambda line: None)
    sessions = [replace(session, frames=session.frames.gated(known.calibration)) for session in sessions]
    chosen = {name: METHODS[name] for name in ("most probable, arm identified", "affine through the sensors")}
    tasks = [Task((0, 2), motors, True) for motors in (False, True)]
    scores, failures = evaluate([known], sessions, settings.data.learned, tasks, chosen, 10, list)
    found = {score.method: score.mean for score in scores}
    assert not failures and found["most probable, arm identified"] < 2.0 < found["affine through the sensors"]


def test_a_method_that_cannot_take_part_is_told(tmp_path: Path, small: tuple[Known, Frames]) -> None:
    class Broken(Linear):
        def fit(self, train: Frames) -> None:
            raise DataError("there is nothing to learn from")

    settings = composed_evaluate(f"data={write_recordings(tmp_path, count=8)}")
    sessions, _ = recordings(settings)
    methods: dict[str, type[Method]] = {"broken": Broken}
    scores, failures = evaluate([small[0]], sessions, "empty", [Task((), True)], methods, 1, list)
    assert not scores and failures == [("broken", "there is nothing to learn from")]


def test_the_numerics_of_regressions_have_as_many_threads_as_are_told() -> None:
    pools = pytest.importorskip("threadpoolctl")
    before = [pool["num_threads"] for pool in pools.threadpool_info()]
    with limited(1):
        assert {pool["num_threads"] for pool in pools.threadpool_info()} <= {1}
    with limited(None):
        assert [pool["num_threads"] for pool in pools.threadpool_info()] == before
