"""A sweep in one process, or a few: points that can share a tensor batch do, in chunks that fit into memory."""

from __future__ import annotations

import csv
import hashlib
import io
import json
import math
import multiprocessing
import shutil
import time
from collections.abc import Hashable, Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, wait
from concurrent.futures.process import BrokenProcessPool
from pathlib import Path
from typing import Any

import torch

from apcc_torch.composition.build import Builder
from apcc_torch.composition.run_settings import SimulateSettings
from apcc_torch.composition.stacking import Point, structure
from apcc_torch.errors import ConfigError, DataError
from apcc_torch.experiments.folder import progress_bar, versions
from apcc_torch.experiments.kinds import BATCHED, kind_of
from apcc_torch.experiments.run import METRICS
from apcc_torch.files import write_atomically, write_json
from apcc_torch.plain_text import for_spreadsheet, plain_logger
from apcc_torch.processes import workers
from apcc_torch.reading import plain
from apcc_torch.sweeps.batch_chunk import ChunkResult, Task, chosen, compute, draw, is_finite, rank, read_part

log = plain_logger("apcc_torch.simulate")

OBJECTIVE = "shape_error_mean_mm"
"""Ranks points where `objective` is null."""
FASTEST_ROWS = 512
"""Rows of a chunk: with more, a step's tensors leave the processor's cache and each row takes longer."""
FEWEST_ROWS = 32
"""Rows below which a chunk is not divided for another worker: a step costs as much for one row as for a few dozen."""
SCRATCH_MIB = 0.15
"""Memory that one row takes within a step, MiB; measured, with room to spare."""
NOT_THE_RUN = (
    *("resume", "overwrite", "jobs", "progress", "prune", "figures", "threads", "batch_memory_mib", "batch_workers"),
)


def run(config: SimulateSettings, points: Sequence[Point], folder: Path) -> dict[str, float]:
    """Runs all points of a batch and writes its folder; returns the metrics of the whole.

    Every finished chunk is kept in a hidden folder, so that a run that was killed goes on where it was with
    `resume=true` and the same folder.

    Args:
        config: The settings of the batch itself.
        points: From `apcc_torch.sweeps.batch_points.batch_points`.
        folder: The batch's.

    Raises:
        ConfigError: The batch's own settings have no meaning, or no point could be run.
    """
    started = time.perf_counter()
    _check(config, points)
    torch.set_num_threads(config.threads or 1)
    parts = parts_folder(config, points, folder)
    if not config.resume:
        shutil.rmtree(parts, ignore_errors=True)
    parts.mkdir(parents=True, exist_ok=True)
    objective = config.objective or OBJECTIVE
    kept = ((config.batch_kept + 1) // 2, config.batch_kept // 2)
    done = gathered(parts)
    there = {*done.metrics, *done.failed}
    tasks = [
        Task(f"from_{chunk[0].number}", chunk, parts, objective, kept)
        for chunk in chunks([point for point in points if point.number not in there], config)
    ]
    log.info("%d points in %d chunks into %s", len(points) - len(there), len(tasks), folder)
    if there:
        log.info("%d of %d points are there already", len(there), len(points))
    _work(tasks, len(points), len(there), config)
    whole = gathered(parts)
    if not whole.metrics:
        raise ConfigError(f"no point could be run; the first one: {next(iter(whole.failed.values()))}")
    for index, why in sorted(whole.failed.items()):
        settings = " ".join(f"{key}={value}" for key, value in points[index].settings.items())
        log.error("point %d failed, %s: %s", index, settings, why)
    order = rank(whole.metrics, objective)
    write_atomically(folder / "points.csv", table(points, whole))
    write_json(folder / "versions.json", {**versions(), "seed": config.seed})
    shown = [points[index] for index in chosen(order, kept)]
    _keep(shown, parts, folder, config)
    diverged = [index for index in sorted(whole.metrics) if not is_finite(whole.metrics[index], objective)]
    if diverged:
        named = ", ".join(map(str, diverged[:10])) + (", …" if len(diverged) > 10 else "")
        log.warning("%d of %d points diverged: %s", len(diverged), len(points), named)
    totals = {
        objective: whole.metrics[order[0]][objective],
        "best_point": order[0],
        "points": len(points),
        "failed_points": len(whole.failed),
        "diverged_points": len(diverged),
        "wall_s": time.perf_counter() - started,
    }
    write_json(folder / METRICS, totals)
    shutil.rmtree(parts, ignore_errors=True)
    for point in shown if config.figures else ():
        draw(point.config, folder / "points" / str(point.number))
    return totals


def _check(config: SimulateSettings, points: Sequence[Point]) -> None:
    for point in points:
        kind_of(point.config, BATCHED, "experiment.kind of a batch")
    if config.prune.after is not None:
        raise ConfigError("prune.after ends runs one by one, and a batch has none; leave it null")


def parts_folder(config: SimulateSettings, points: Sequence[Point], folder: Path) -> Path:
    """Where finished chunks wait: hidden in the batch's folder, or in that of the sweep if the batch is a job of one.

    Its name tells what is computed, so that other settings never meet the chunks of these.
    """
    settings = {key: value for key, value in plain(config).items() if key not in NOT_THE_RUN}
    told = json.dumps([settings, [point.settings for point in points], versions()], sort_keys=True, default=str)
    # A job of a sweep writes into a draft, which is gone if the job is killed.
    outer = folder.parent if folder.name.startswith(".") and folder.name.endswith(".draft") else folder
    return outer / f".batch_{hashlib.sha256(told.encode()).hexdigest()[:16]}"


def point_mib(config: SimulateSettings) -> tuple[int, float]:
    """Rows that one point takes, and its memory in MiB: its log, twice while it is read, and scratch."""
    e, model, k = config.experiment, Builder(config).backbone(), config.arm.sensor_places().shape[-1]
    numbers = 6 + 2 * model.n + model.n_sections + 2 * k + 1
    if e.kind == "kinematic":
        rows = 1 + e.start_errors
    else:
        rows = len(e.setpoints or [None]) * len(e.payloads)
        # A true arm has at most six coordinates in each of its parts.
        numbers += model.n + 6 * config.arm.n_sections * config.plant.refine + 3 * config.arm.n_tendons
    steps = round(e.duration * config.controller.rate) + 1
    window = config.velocity_filter.window
    filtered = 4 * int(torch.as_tensor(window).max()) * model.n // 3
    return rows, rows * (SCRATCH_MIB + 8.0 * (2.0 * steps * numbers + filtered) / 2**20)


def chunks(points: Sequence[Point], config: SimulateSettings) -> Iterator[Sequence[Point]]:
    """Points side by side, each chunk of one structure and small enough for `batch_memory_mib` over all workers."""
    groups: dict[Hashable, list[Point]] = {}
    for point in points:
        groups.setdefault(structure(point.config), []).append(point)
    for group in groups.values():
        rows, mib = max(point_mib(point.config) for point in group)
        most = max(1, min(int(config.batch_memory_mib / config.batch_workers / mib), FASTEST_ROWS // rows))
        needed = -(-len(group) // most)
        useful = min(config.batch_workers, len(group) * rows // FEWEST_ROWS, len(group))
        count = max(needed, useful, 1)
        for i in range(count):
            yield group[len(group) * i // count : len(group) * (i + 1) // count]


def gathered(parts: Path) -> ChunkResult:
    """All finished chunks as one."""
    whole = ChunkResult({}, {})
    for path in sorted(parts.glob("*.json")):
        try:
            part = read_part(path)
        except DataError as error:
            log.warning("%s; its points are run again", error)
            continue
        whole.metrics.update(part.metrics)
        whole.failed.update(part.failed)
    return whole


def table(points: Sequence[Point], whole: ChunkResult) -> str:
    """points.csv: a point, its swept keys, its metrics; those of a point that failed are empty."""
    names = list(dict.fromkeys(name for metrics in whole.metrics.values() for name in metrics))
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(map(for_spreadsheet, ("point", *points[0].settings, *names)))
    for point in points:
        metrics = whole.metrics.get(point.number, {})
        # repr: a number that is read back is the same to the last bit.
        numbers = [repr(metrics[name]) if name in metrics else "" for name in names]
        writer.writerow([point.number, *map(for_spreadsheet, point.settings.values()), *numbers])
    return text.getvalue()


def _keep(points: Sequence[Point], parts: Path, folder: Path, config: SimulateSettings) -> None:
    """Puts the folders of the best and the worst points into place; the parts stay until all is there."""
    shutil.rmtree(folder / "points", ignore_errors=True)
    for point in points:
        draft = parts / "points" / str(point.number)
        if not (draft / METRICS).is_file():
            # A chunk that was computed when fewer were to be kept.
            compute(Task("alone", [point], parts / "again", config.objective or OBJECTIVE, (1, 0)), lambda _: None)
            draft = parts / "again" / "points" / str(point.number)
        shutil.copytree(draft, folder / "points" / str(point.number))


def _work(tasks: Sequence[Task], total: int, done: int, config: SimulateSettings) -> None:
    """Runs the chunks, over several processes where there are several."""
    bar = _Bar(total, done, config)
    if len(tasks) < 2 or config.batch_workers == 1:
        for task in tasks:
            compute(task, bar.more)
        bar.close()
        return
    count = multiprocessing.get_context("spawn").Value("d", 0.0)
    try:
        with workers(min(config.batch_workers, len(tasks)), _begin, count, config.threads or 1) as pool:
            waiting: set[Future[None]] = {pool.submit(_compute_there, task) for task in tasks}
            while waiting:
                ended, waiting = wait(waiting, 0.5, FIRST_COMPLETED)
                bar.at(count.value)
                for future in ended:
                    future.result()
    except BrokenProcessPool as error:
        raise ConfigError(
            "a worker of the batch was killed, perhaps for its memory: lower batch_memory_mib; resume=true goes on"
        ) from error
    bar.close()


_count: Any = None


def _begin(count: Any, threads: int) -> None:
    global _count
    _count = count
    torch.set_num_threads(threads)


def _compute_there(task: Task) -> None:
    def tell(points: float) -> None:
        with _count.get_lock():
            _count.value += points

    compute(task, tell)


class _Bar:
    """One bar over the points of a batch, which may be done in parts."""

    def __init__(self, total: int, done: int, config: SimulateSettings) -> None:
        self.done, self.shown = float(done), 0
        self.steps = iter(progress_bar("batch", config.progress)(range(total + 1)))
        self.before = float(done)
        self.at(0.0)

    def more(self, points: float) -> None:
        """Some more are done."""
        self.done += points
        self._show()

    def at(self, points: float) -> None:
        """So many are done in this run."""
        self.done = self.before + points
        self._show()

    def _show(self) -> None:
        while self.shown <= math.floor(self.done + 1e-6):
            next(self.steps, None)
            self.shown += 1

    def close(self) -> None:
        """All are done."""
        for _ in self.steps:
            pass
