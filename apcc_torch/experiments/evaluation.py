"""Evaluation on recordings: settings to a folder with the leaderboard, its figures and a page."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Sequence
from contextlib import AbstractContextManager, nullcontext
from dataclasses import replace
from importlib.util import find_spec
from pathlib import Path

import torch

from apcc_torch.bars import terminal_bar
from apcc_torch.composition.evaluate import EvaluateSettings, recordings
from apcc_torch.composition.identify import parameters
from apcc_torch.evaluation.coverage import covered
from apcc_torch.evaluation.leaderboard import Failure, evaluate
from apcc_torch.evaluation.method import Known
from apcc_torch.evaluation.methods import METHODS
from apcc_torch.evaluation.payload import payloads
from apcc_torch.evaluation.statics import statics_scores
from apcc_torch.evaluation.tasks import tasks_of
from apcc_torch.experiments.folder import versions
from apcc_torch.files import write_atomically, write_json
from apcc_torch.recordings.data_set import located
from apcc_torch.recordings.rod_shapes import read_rod_shapes
from apcc_torch.report.evaluation import Leaderboard
from apcc_torch.report.style import save_figures

Say = Callable[[str], None]


def run(settings: EvaluateSettings, folder: Path, say: Say) -> str:
    """Evaluates, writes the run's folder and returns the leaderboard as text.

    Raises:
        ConfigError: A setting has no meaning.
        DataError: The recordings cannot be had, read or used.
    """
    started = time.perf_counter()
    if settings.threads is not None:
        torch.set_num_threads(settings.threads)
    with limited(settings.threads):
        board = of_statics(settings) if settings.data.kind == "statics" else of_motion(settings, say)
    text = board.text()
    write_atomically(folder / "table.txt", text + "\n")
    write_atomically(folder / "table.md", board.markdown() + "\n")
    wall = time.perf_counter() - started
    write_json(folder / "versions.json", {**versions(), "seed": settings.seed})
    write_json(folder / "table.json", {**board.table(), "wall_s": wall})
    write_json(folder / "metrics.json", {**board.metrics(), "wall_s": wall})
    if settings.figures:
        save_figures(board.figures(), folder / "figures")
    foot = f"python -m apcc_torch.evaluate, {wall:.0f} s; " + ", ".join(f"{k} {v}" for k, v in versions().items())
    write_atomically(folder / "leaderboard.html", board.page(folder, foot))
    return text


def limited(threads: int | None) -> AbstractContextManager[object]:
    """As many threads for the numerics of scikit-learn: on small systems they wait for each other. None: as it is."""
    if threads is None or find_spec("threadpoolctl") is None:
        return nullcontext()
    from threadpoolctl import threadpool_limits

    limits: AbstractContextManager[object] = threadpool_limits(threads)
    return limits


def of_statics(settings: EvaluateSettings) -> Leaderboard:
    """Every plant on shapes that are known."""
    data = settings.data
    folder, scores = located(data, settings.data_root), []
    for name, session in data.sessions.items():
        shapes = read_rod_shapes(folder / session.file).each(settings.every)
        scores += statics_scores(settings.arm, shapes, name)
    return Leaderboard(data.name, scores, [], [])


def of_motion(settings: EvaluateSettings, say: Say) -> Leaderboard:
    """Every method on every task that the recordings allow."""
    unread: list[Failure] = []
    sessions, rest = recordings(settings, lambda name, why: unread.append(Failure(f"session {name}", str(why))))
    blocks, fit = parameters(settings), settings.fit
    geometric = blocks.holding(fit.geometric)

    def known() -> Known:
        return Known(settings.arm, blocks, geometric, rest, fit, fit.samples, settings.seed, say)

    calibration = known().calibration
    sessions = [replace(session, frames=session.frames.gated(calibration)) for session in sessions]
    # What is followed is seen before it is scored, in the same file.
    learned, loads = settings.data.learned, len(sessions) > 1 and not settings.data.validation
    k, turned = sessions[0].frames.positions.shape[1], bool(sessions[0].frames.rotations.isfinite().any())
    tasks = [task for task in tasks_of(k, turned) if loads or not task.online]
    chosen = {name: METHODS[name] for name in settings.methods or METHODS}

    def watch(names: Sequence[str]) -> Iterable[str]:
        watched: Iterable[str] = terminal_bar(names, desc="methods", shown=settings.progress)
        return watched

    told = [known() for _ in sessions[0].folds]
    scores, failures = evaluate(told, sessions, learned, tasks, chosen, settings.every, watch)
    weighed = payloads(told[0], sessions, learned, 0) if loads and "arm identified" in chosen else []
    judged = any(score.method == "arm identified" for score in scores)
    honest = covered(told, sessions, learned, settings.every) if judged else []
    return Leaderboard(settings.data.name, scores, weighed, [*unread, *failures], honest)
