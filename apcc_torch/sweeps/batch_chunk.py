"""One chunk of a batch: runs side by side as rows of one tensor batch; their metrics in a file, whole or absent."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from apcc_torch.composition.run_settings import SimulateSettings
from apcc_torch.composition.schema import text
from apcc_torch.composition.stacking import Point, stacked
from apcc_torch.errors import ApccError, DataError, in_a_line
from apcc_torch.experiments.folder import RunFolder
from apcc_torch.experiments.kinds import BATCHED, kind_of
from apcc_torch.experiments.run import objective_value
from apcc_torch.files import json_in, read_arrays, read_text, write_atomically, write_json
from apcc_torch.simulation.progress import Progress

Tell = Callable[[float], None]
"""Told how many more points, in parts, are done."""


class Task(NamedTuple):
    """What a worker is given.

    name: Of the chunk's file, without suffix.
    points: Of one `stacking.structure`.
    folder: Where the file goes.
    objective: The metric that ranks points.
    kept: How many of the best, and how many of the worst, leave a folder each.
    """

    name: str
    points: Sequence[Point]
    folder: Path
    objective: str
    kept: tuple[int, int]


class ChunkResult(NamedTuple):
    """What a chunk left: metrics of its points by their numbers, and why others failed."""

    metrics: dict[int, dict[str, float]]
    failed: dict[int, str]


def rank(metrics: Mapping[int, Mapping[str, float]], objective: str) -> list[int]:
    """The points from the best to the worst; one that diverged comes last.

    Raises:
        ConfigError: There is no such metric.
    """
    return sorted(metrics, key=lambda index: (objective_value(metrics[index], objective), index))


def chosen(order: Sequence[int], kept: tuple[int, int]) -> list[int]:
    """The first and the last of an order, each once."""
    best, worst = kept
    return list(dict.fromkeys([*order[:best], *order[max(0, len(order) - worst) :]]))


def compute(task: Task, tell: Tell) -> None:
    """Runs a chunk and writes its file; before it, the folders of its best and worst points."""
    part = ChunkResult({}, {})
    held: dict[int, Any] = {}
    _compute(task, task.points, part, held, tell)
    for index in chosen(rank(part.metrics, task.objective), task.kept):
        point, outcome = held[index]
        save(point, outcome, part.metrics[index], task.folder / "points" / str(index))
    entry = {"metrics": part.metrics, "failed": part.failed}
    write_json(task.folder / f"{task.name}.json", entry)


def _compute(task: Task, points: Sequence[Point], part: ChunkResult, held: dict[int, Any], tell: Tell) -> None:
    """Runs points side by side. Where one of them is refused, each half on its own: only that one is lost."""
    started = time.perf_counter()
    kind = kind_of(points[0].config, BATCHED)
    try:
        outcome = kind.simulate(
            stacked([point.config for point in points]), points=len(points), progress=_steps(len(points), tell)
        )
    except ApccError as error:
        if len(points) == 1:
            part.failed[points[0].number] = str(error)
            tell(1.0)
            return
        half = len(points) // 2
        _compute(task, points[:half], part, held, tell)
        _compute(task, points[half:], part, held, tell)
        return
    for p, point in enumerate(points):
        part.metrics[point.number] = kind.metrics(kind.one_of(outcome, point.config, p))
    share = (time.perf_counter() - started) / len(points)
    for point in points:
        part.metrics[point.number]["wall_s"] = share
    # Only these can be among the whole batch's best and worst; the others' logs are let go.
    own = {point.number: part.metrics[point.number] for point in points}
    positions = {point.number: p for p, point in enumerate(points)}
    for index in chosen(rank(own, task.objective), task.kept):
        p = positions[index]
        held[index] = points[p], kind.one_of(outcome, points[p].config, p)


def _steps(points: int, tell: Tell) -> Progress:
    """Tells of the points as the steps of their simulation go by."""

    def going(steps: Any) -> Any:
        share, waiting = points / len(steps), 0
        for step in steps:
            yield step
            waiting += 1
            if waiting == 32:
                tell(share * waiting)
                waiting = 0
        tell(share * waiting)

    return going


def save(point: Point, outcome: Any, metrics: Mapping[str, float], folder: Path) -> None:
    """Writes a point's run folder, without figures."""
    write_atomically(folder / "config.yaml", text(point.config))
    arrays = kind_of(point.config, BATCHED).arrays(outcome)
    RunFolder(folder).write(metrics, arrays, point.config.seed)


def draw(config: SimulateSettings, folder: Path) -> None:
    """The figures of a run folder that `save` wrote."""
    kind = kind_of(config, BATCHED)
    kind.draw(kind.loaded(config, read_arrays(folder / "trajectory.npz")), folder / "figures")


def read_part(path: Path) -> ChunkResult:
    """A chunk's file.

    Raises:
        DataError: It cannot be read, or holds something else.
    """
    entry = json_in(read_text(path), path.name)
    try:
        metrics = {int(index): dict(each) for index, each in entry["metrics"].items()}
        if not all(isinstance(value, int | float) for each in metrics.values() for value in each.values()):
            raise ValueError("a metric is no number")
        return ChunkResult(metrics, {int(index): str(why) for index, why in entry["failed"].items()})
    except (AttributeError, KeyError, TypeError, ValueError) as error:
        raise DataError(f"{path.name} is no chunk of a batch: {in_a_line(error)}") from error


def is_finite(metrics: Mapping[str, float], objective: str) -> bool:
    """Whether a point did not diverge."""
    return math.isfinite(objective_value(metrics, objective))
