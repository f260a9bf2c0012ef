"""The bars of a sweep: one for the sweep with the time left, one for each job that runs.

They are drawn from what lies in the sweep's folder, so they are the same whatever runs the jobs: this process, its
children, or a cluster that shares the folder.
"""

from __future__ import annotations

import sys
import threading
from typing import Any, NamedTuple, Never, TextIO

from tqdm import tqdm

from apcc_torch.bars import terminal_bar
from apcc_torch.errors import DataError
from apcc_torch.files import json_in, read_text
from apcc_torch.plain_text import for_terminal
from apcc_torch.sweeps.sweep_folder import PROGRESS, SweepFolder, job_name

PERIOD = 0.5
"""Time between two looks into the folder, s."""
SHOWN_JOBS = 8
"""Most jobs with a bar of their own."""
LAYOUT = "{desc} {percentage:3.0f}% |{bar}| {elapsed}<{remaining}"


class Running(NamedTuple):
    """A job that runs."""

    name: str
    label: str
    share: float  # of its steps that are done, 0 to 1


def running(folder: SweepFolder) -> list[Running]:
    """The jobs that have said how far they are."""
    result = []
    for draft in folder.drafts():
        try:
            told = json_in(read_text(draft / PROGRESS), PROGRESS)
            share = told["done"] / told["steps"] if told["steps"] else 0.0
            result.append(Running(job_name(draft), str(told["label"]), share))
        except (DataError, KeyError, TypeError):
            continue  # not begun, or just ended: the folder is another process's to move
    return sorted(result, key=lambda job: (len(job.name), job.name))


class SweepBars:
    """Draws a sweep's bars in a thread of its own until it is told to stop.

    Args:
        folder: The sweep's folder.
        total: Number of jobs.
        file: Where to draw; nothing is drawn where this is not a terminal.
    """

    def __init__(self, folder: SweepFolder, total: int, file: TextIO | None = None) -> None:
        self.folder = folder
        self.total = total
        self.file = sys.stderr if file is None else file
        self._stop = threading.Event()
        self._thread: threading.Thread | None = None
        self._bars: list[tqdm[Never]] = []
        self._before = len(list(folder.finished()))

    def start(self) -> None:
        """Begins to draw."""
        if self.file.isatty():
            self._thread = threading.Thread(target=self._watch, daemon=True)
            self._thread.start()

    def stop(self) -> None:
        """Ends the bars."""
        self._stop.set()
        if self._thread is not None:
            self._thread.join()
            self._thread = None

    def _watch(self) -> None:
        self._bars = [self._bar(0, self.total, "sweep")]
        # What an earlier sweep left says nothing about the time that this one takes.
        self._bars[0].initial = self._bars[0].n = self._before
        while not self._stop.wait(PERIOD):
            self._draw()
        for bar in reversed(self._bars):
            bar.close()

    def _bar(self, position: int, total: int, label: str) -> tqdm[Never]:
        look: dict[str, Any] = {
            "total": total,
            "desc": label,
            "position": position,
            "bar_format": LAYOUT,
            "leave": position == 0,
        }
        made: tqdm[Never] = terminal_bar(file=self.file, **look)
        return made

    def _draw(self) -> None:
        jobs = running(self.folder)
        done = len(list(self.folder.finished())) + len(self.folder.failures())
        sweep = self._bars[0]
        # A job half done counts as half: the time left is known before the first one ends.
        sweep.n = min(self.total, done + sum(job.share for job in jobs))
        sweep.set_description_str(f"sweep, {done} of {self.total} jobs", refresh=False)
        sweep.refresh()
        for row in range(1, SHOWN_JOBS + 1):
            if row <= len(jobs):
                self._draw_job(row, jobs[row - 1])
            elif row < len(self._bars):
                self._bars.pop().close()

    def _draw_job(self, row: int, job: Running) -> None:
        label = for_terminal(f"  {job.name}: {job.label}")
        if row >= len(self._bars):
            self._bars.append(self._bar(row, 1, label))
        bar = self._bars[row]
        if not bar.desc.startswith(label):
            bar.set_description_str(label, refresh=False)
            bar.reset()
        bar.n = job.share
        bar.refresh()
