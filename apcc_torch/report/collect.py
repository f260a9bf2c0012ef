"""Finds runs below any folders: complete ones, failed ones, unfinished ones, and the points of batches."""

from __future__ import annotations

import os
import re
from collections import deque
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from apcc_torch.errors import ApccError, DataError
from apcc_torch.report.batch_table import POINTS, read_points
from apcc_torch.report.run_record import (
    BROKEN,
    COMPLETE,
    FAILED,
    PRUNED,
    UNFINISHED,
    Run,
    read_json,
    read_metrics,
    read_overrides,
    read_settings,
    read_versions,
    there,
)

DRAFT = re.compile(r"\.(?P<name>.+)\.\d+\.draft")
"""The hidden folder that a sweep's job writes into until it has ended well."""
FAILED_SUFFIX = ".failed"
LONGEST_WHY = 1000
"""Most characters of what a run's folder says of why it failed."""
LOG_END = 2**20
"""What is read of a log, bytes: the last error is in it."""
ERROR_LINE = re.compile(r"\[(?:ERROR|CRITICAL)\] - (.*)")

Watch = Callable[[Iterable[Path]], Iterable[Path]]


@dataclass(frozen=True)
class Collection:
    """Runs in the order of their folders, and a line for each thing that was passed over."""

    runs: list[Run]
    skipped: list[str]


def natural(name: str) -> list[tuple[int, int, str]]:
    """A sorting key under which 2 comes before 10."""
    parts = re.split(r"(\d{1,300})", name.lstrip("."))
    return [(0, int(part), "") if part.isdecimal() else (1, 0, part) for part in parts if part]


def is_run(folder: Path) -> bool:
    """Whether the folder is a run's: one with its settings or its metrics, or one that hydra has begun."""
    return any(there(folder / name) for name in ("config.yaml", "metrics.json", ".hydra", "failure.json"))


def run_folders(root: Path, skipped: list[str]) -> list[Path]:
    """Every run's folder at or below `root`, in natural order; a line in `skipped` for what is passed over.

    Hidden folders are passed over but for the drafts of jobs that were killed or still run. A link is followed once all
    that is no link has been seen, no folder is looked at twice, and none above `root`: links may lead in circles.
    """
    found: list[Path] = []
    seen: set[str] = set()
    to_see, links = [root], deque[Path]()
    while to_see or links:
        folder = to_see.pop() if to_see else links.popleft()
        place = os.path.realpath(folder)
        if place in seen or (folder != root and root.is_relative_to(place)):
            continue
        seen.add(place)
        if os.path.isfile(folder / "table.json"):
            skipped.append(f"{folder.name} is passed over: a benchmark's folder, whose own table is in table.json")
        elif is_run(folder) or (folder != root and DRAFT.fullmatch(folder.name)):
            found.append(folder)
        else:
            inner = _inside(folder, skipped)
            links += [path for path in inner if path.is_symlink()]
            to_see += [path for path in reversed(inner) if not path.is_symlink()]
    return sorted(found, key=lambda folder: [natural(part) for part in folder.relative_to(root).parts])


def _inside(folder: Path, skipped: list[str]) -> list[Path]:
    """The folders in a folder that may hold runs, in natural order; a line in `skipped` if it cannot be read."""
    try:
        names = os.listdir(folder)
    except OSError as error:
        skipped.append(f"{folder.name} is passed over: {error.strerror}")
        return []
    drafts = {name: draft["name"] for name in names if (draft := DRAFT.fullmatch(name)) is not None}
    shown = [name for name in names if not name.startswith(".") or (name in drafts and drafts[name] not in names)]
    return [folder / name for name in sorted(shown, key=natural) if os.path.isdir(folder / name)]


def collect(folders: Sequence[Path], watch: Watch | None = None) -> Collection:
    """Every run at or below the folders.

    Args:
        folders: Run folders, sweeps, or folders of them.
        watch: Wraps the run folders as they are read, for a progress bar.

    Raises:
        DataError: A folder is not there, or there is no run in any.
    """
    skipped: list[str] = []
    result: dict[Path, None] = {}
    roots = [Path(os.path.realpath(folder)) for folder in folders]
    for folder, root in zip(folders, roots, strict=True):
        if not root.is_dir():
            raise DataError(f"RUNS must name folders of runs, but {folder} is not a folder")
        result |= dict.fromkeys(run_folders(root, skipped))
    base = Path(os.path.commonpath(roots))
    runs = [run for folder in (result if watch is None else watch(result)) for run in read_folder(folder, base)]
    if not runs:
        hint = f" ({skipped[0]})" if skipped else ""
        places = ", ".join(str(folder) for folder in folders)
        raise DataError(f"RUNS must hold at least one run, a folder with config.yaml; found none in {places}{hint}")
    return Collection(runs, skipped)


def run_name(folder: Path, base: Path) -> str:
    """The folder below `base`, or its own name where it is the base; without the marks of a draft or a failed job."""
    relative = folder.relative_to(base)
    draft = DRAFT.fullmatch(folder.name)
    last = draft["name"] if draft is not None else folder.name.removesuffix(FAILED_SUFFIX) or folder.name
    return relative.with_name(last).as_posix() if relative.name else last


def read_folder(folder: Path, base: Path) -> list[Run]:
    """The run of a folder, or the points of a batch; what cannot be read makes a run that is broken, not an error."""
    run = Run(run_name(folder, base), UNFINISHED)
    try:
        overrides = read_overrides(folder)
        run = replace(run, overrides=overrides, settings=read_settings(folder, overrides))
        if not there(folder / "metrics.json"):
            status, note = fate(folder)
            return [replace(run, status=status, note=note)]
        versions = read_versions(folder / "versions.json")
        run = replace(run, versions=versions, metrics=read_metrics(folder / "metrics.json"), status=COMPLETE)
        if there(folder / POINTS):
            return list(read_points(folder, run, "" if folder == base else f"{run.name}/"))
    except (ApccError, OSError) as error:
        return [replace(run, status=BROKEN, metrics={}, note=str(error))]
    lost = run.metrics.get("diverged_rows", 0.0)
    notes = [f"{lost:.0f} of {run.metrics.get('rows', 1.0):.0f} rows diverged"] if lost else []
    if not (folder / "trajectory.npz").is_file():
        notes.append("trajectory.npz is missing")
    return [replace(run, folder=folder, note=", ".join(notes))]


def fate(folder: Path) -> tuple[str, str]:
    """What became of a run without metrics, and why.

    Raises:
        DataError: The file that says so cannot be read.
    """
    for name, status in (("failure.json", FAILED), ("pruned.json", PRUNED)):
        if there(folder / name):
            why = read_json(folder / name).get("why")
            return status, " ".join(why.split())[:LONGEST_WHY] if isinstance(why, str) else ""
    for path in sorted(path for path in folder.glob("*.log") if os.path.isfile(path)):
        errors = ERROR_LINE.findall(_end_of(path))
        if errors:
            return FAILED, errors[-1].strip()[:LONGEST_WHY]
    return UNFINISHED, "metrics.json is missing: the run was killed, or still runs"


def _end_of(log: Path) -> str:
    """The text of a log, of a long one its end.

    Raises:
        DataError: It cannot be read.
    """
    try:
        with log.open("rb") as file:
            file.seek(max(0, log.stat().st_size - LOG_END))
            return file.read(LOG_END).decode("utf-8", errors="replace")
    except OSError as error:
        raise DataError(f"{log.name} cannot be read: {error.strerror}") from error
