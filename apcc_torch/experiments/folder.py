"""What every run leaves behind: metrics, data, versions."""

from __future__ import annotations

import json
import platform
import time
from collections.abc import Iterable, Iterator, Mapping, Sized
from contextlib import contextmanager, suppress
from contextvars import ContextVar
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

import apcc_torch
from apcc_torch.bars import terminal_bar
from apcc_torch.errors import WriteError
from apcc_torch.files import draft_of, write_arrays, write_json
from apcc_torch.plain_text import plain_logger
from apcc_torch.simulation.progress import Progress, quiet

log = plain_logger(__name__)

_told: ContextVar[Path | None] = ContextVar("progress_file", default=None)
_TELL_EVERY = 0.5
"""Time between two writes of a progress file, s."""


def progress_bar(label: str, shown: bool) -> Progress:
    """A progress bar over steps; silent where it is not wanted or there is no terminal.

    Inside `progress_told` there is no bar: the steps are told to a file, from which another process may draw one.
    """
    path = _told.get()
    if path is None:
        return lambda steps: terminal_bar(steps, desc=label, shown=shown)
    return (lambda steps: _telling(steps, label, path)) if shown else quiet


@contextmanager
def progress_told(path: Path) -> Iterator[None]:
    """Bars within the block write {label, done, steps} to the JSON file `path` instead of drawing themselves."""
    token = _told.set(path)
    try:
        yield
    finally:
        _told.reset(token)


def _telling(steps: Iterable[int], label: str, path: Path) -> Iterator[int]:
    total = len(steps) if isinstance(steps, Sized) else None
    told_at = -_TELL_EVERY
    for done, step in enumerate(steps):
        now = time.monotonic()
        if now - told_at >= _TELL_EVERY:
            told_at = now
            # Whole or not at all, but not forced to the disk: nobody misses it after a crash, or on a full disk.
            with suppress(WriteError), draft_of(path) as draft:
                draft.write_text(json.dumps({"label": label, "done": done, "steps": total}))
        yield step


def warn(of: str | None, run: str = "") -> None:
    """Logs what a run's numbers have to be read with, if there is something; the run itself is complete."""
    if of is not None:
        log.warning("%s%s", f"{run}: " if run else "", of)


def metrics_text(metrics: Mapping[str, float]) -> str:
    """One line a metric, for a log."""
    width = max(len(name) for name in metrics)
    return "\n".join(f"  {name:<{width}}  {value:.6g}" for name, value in metrics.items())


def versions() -> dict[str, str]:
    """Versions that a result depends on."""
    return {
        "apcc_torch": apcc_torch.__version__,
        "torch": torch.__version__,
        "numpy": np.__version__,
        "python": platform.python_version(),
        "machine": platform.machine(),
        "system": platform.system(),
        "torch_threads": str(torch.get_num_threads()),
    }


@dataclass(frozen=True)
class RunFolder:
    """The folder of one run."""

    path: Path

    def write(self, metrics: Mapping[str, float], arrays: Mapping[str, Tensor], seed: int) -> None:
        """Writes trajectory.npz, versions.json and, last, metrics.json: a folder with metrics is complete."""
        write_arrays(self.path / "trajectory.npz", arrays)
        write_json(self.path / "versions.json", {**versions(), "seed": seed})
        write_json(self.path / "metrics.json", metrics)

    @property
    def figures(self) -> Path:
        """Where the figures go."""
        return self.path / "figures"
