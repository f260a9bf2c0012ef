"""Finds runs below any folders: complete ones, failed ones, unfinished ones, and the points of batches."""

from __future__ import annotations

import os
import re
from collections.abc import Callable, Iterable, Iterator, Sequence
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
)

DRAFT = re.compile(r"\.(?P<name>.+)\.\d+\.draft")
"""The hidden folder that a sweep's job writes into until it has ended well."""
FAILED_SUFFIX = ".failed"
ERROR_LINE = re.compile(r"\[(?:ERROR|CRITICAL)\] - (.*)")

Watch = Callable[[Iterable[Path]], Iterable[Path]]


@dataclass(frozen=True)
class Collection:
    """Runs in the order of their folders, and a line for each thing that was passed over."""

    runs: list[Run]
    skipped: list[str]


def natural(path: Path) -> list[tuple[int, int, str]]:
    """A sorting key under which 2 comes before 10."""
    parts = re.split(r"(\d+)", path.name.lstrip("."))
    return [(0, int(part), "") if part.isdigit() else (1, 0, part) for part in parts if part]


def is_run(folder: Path) -> bool:
    """Whether the folder is a run's: one with its settings or its metrics, or one that hydra has begun."""
    return any((folder / name).exists() for name in ("config.yaml", "metrics.json", ".hydra", "failure.json"))


def run_folders(root: Path, skipped: list[str]) -> Iterator[Path]:
    """Every run's folder at or below `root`, in natural order; a line in `skipped` for each benchmark's.

    Hidden folders are passed over but for the drafts of jobs that were killed or still run.
    """
    if (root / "table.json").is_file():
        skipped.append(f"{root.name} is passed over: a benchmark's folder, whose own table is in table.json")
        return
    if is_run(root):
        yield root
        return
    for inner in sorted((path for path in root.iterdir() if path.is_dir()), key=natural):
        draft = DRAFT.fullmatch(inner.name)
        if draft is not None and not (root / draft["name"]).exists():
            yield inner
        elif not inner.name.startswith("."):
            yield from run_folders(inner, skipped)


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
    roots = [folder.resolve() for folder in folders]
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
    last = draft["name"] if draft is not None else folder.name.removesuffix(FAILED_SUFFIX)
    return relative.with_name(last).as_posix() if relative.name else last


def read_folder(folder: Path, base: Path) -> list[Run]:
    """The run of a folder, or the points of a batch; what cannot be read makes a run that is broken, not an error."""
    run = Run(run_name(folder, base), UNFINISHED)
    try:
        overrides = read_overrides(folder)
        run = replace(run, overrides=overrides, settings=read_settings(folder, overrides))
        if not (folder / "metrics.json").is_file():
            status, note = fate(folder)
            return [replace(run, status=status, note=note)]
        versions = read_json(folder / "versions.json") if (folder / "versions.json").is_file() else {}
        run = replace(run, versions=versions, metrics=read_metrics(folder / "metrics.json"), status=COMPLETE)
        if (folder / POINTS).is_file():
            return list(read_points(folder, run, "" if folder == base else f"{run.name}/"))
    except ApccError as error:
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
        if (folder / name).is_file():
            return status, str(read_json(folder / name).get("why", ""))
    for path in sorted(folder.glob("*.log")):
        errors = ERROR_LINE.findall(path.read_text(encoding="utf-8", errors="replace"))
        if errors:
            return FAILED, errors[-1].strip()
    return UNFINISHED, "metrics.json is missing: the run was killed, or still runs"
