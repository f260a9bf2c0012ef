"""Evaluation on recordings: settings to a folder with the leaderboard, its figures and a page."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Sequence
from dataclasses import replace
from pathlib import Path

import torch
from tqdm import tqdm

from apcc_torch.composition.evaluate import EvaluateSettings, recordings
from apcc_torch.composition.identify import parameters
from apcc_torch.evaluation.frames import Frames
from apcc_torch.evaluation.leaderboard import Session, evaluate
from apcc_torch.evaluation.method import Known
from apcc_torch.evaluation.methods import METHODS
from apcc_torch.evaluation.payload import payloads
from apcc_torch.evaluation.tasks import tasks_of
from apcc_torch.experiments.folder import versions
from apcc_torch.files import write_atomically, write_json
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
    sessions, rest = recordings(settings)
    blocks = parameters(settings)

    def known() -> Known:
        geometric, fit = blocks.holding(settings.fit.geometric), settings.fit
        return Known(settings.arm, blocks, geometric, rest, fit, fit.samples, settings.seed, say)

    board = leaderboard(settings, sessions, rest, known)
    text = board.text()
    write_atomically(folder / "table.txt", text + "\n")
    write_atomically(folder / "table.md", board.markdown() + "\n")
    if settings.figures:
        save_figures(board.figures(), folder / "figures")
    wall = time.perf_counter() - started
    write_json(folder / "versions.json", {**versions(), "seed": settings.seed})
    foot = f"python -m apcc_torch.evaluate, {wall:.0f} s; " + ", ".join(f"{k} {v}" for k, v in versions().items())
    write_atomically(folder / "leaderboard.html", board.page(folder, foot))
    write_json(folder / "table.json", {**board.table(), "wall_s": wall})
    return text


def leaderboard(
    settings: EvaluateSettings, sessions: Sequence[Session], rest: Frames | None, known: Callable[[], Known]
) -> Leaderboard:
    """Every method on every task that the recordings allow."""
    first = known()
    sessions = [replace(session, frames=session.frames.gated(first.calibration)) for session in sessions]
    learned = settings.data.learned
    k, turned = sessions[0].frames.positions.shape[1], bool(sessions[0].frames.rotations.isfinite().any())
    loads = len(sessions) > 1
    tasks = [task for task in tasks_of(k, turned) if loads or not task.online]
    chosen = {name: METHODS[name] for name in settings.methods or METHODS}

    def watch(names: Sequence[str]) -> Iterable[str]:
        bar: Iterable[str] = tqdm(names, "methods", disable=None if settings.progress else True, leave=False)
        return bar

    scores, failures = evaluate(known, sessions, learned, tasks, chosen, settings.every, watch)
    weighed = payloads(first, sessions, learned, 0) if loads and not settings.methods else []
    return Leaderboard(settings.data.name, scores, weighed, failures)
