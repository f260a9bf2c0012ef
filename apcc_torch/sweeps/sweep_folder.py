"""The folder of a sweep: each job's folder is complete or absent, whatever is killed and whenever.

A job writes into a draft, a folder with a hidden name, which is renamed into place as a whole when the job has ended
well. A job that ended badly leaves NAME.failed, with its log and why; a killed one its draft. Neither counts as there.
"""

from __future__ import annotations

import hashlib
import json
import os
import re
import shutil
import uuid
from collections.abc import Iterator, Sequence
from itertools import chain
from pathlib import Path
from typing import Any, NamedTuple

from apcc_torch.composition.run_settings import SimulateSettings
from apcc_torch.errors import ConfigError, DataError
from apcc_torch.experiments.run import PRUNED, pruning
from apcc_torch.files import json_in, read_text, write_json
from apcc_torch.plain_text import plain_logger
from apcc_torch.reading import plain

log = plain_logger("apcc_torch.simulate")

JOB, FAILURE, PROGRESS = "job.json", "failure.json", "progress.json"
DRAFT = re.compile(r"\.(?P<name>.+)\.\d+\.draft")
FAILED = ".failed"

# What does not change a run's results. Pruning is compared where a run was pruned, and only there.
NOT_THE_RUN = ("resume", "overwrite", "jobs", "progress", "objective", "prune", "batch_memory_mib", "batch_workers")


class Failure(NamedTuple):
    """A job that ended badly."""

    folder: Path
    overrides: list[str]
    why: str


def fingerprint(config: SimulateSettings) -> str:
    """The same for two configurations exactly when their runs are the same."""
    settings = {key: value for key, value in plain(config).items() if key not in NOT_THE_RUN}
    return hashlib.sha256(json.dumps(settings, sort_keys=True).encode()).hexdigest()[:16]


def job_name(draft: Path) -> str:
    """The name that a job's finished folder will have.

    Raises:
        ConfigError: The draft's own name does not say.
    """
    folders = DRAFT.fullmatch(draft.name)
    if folders is None:
        raise ConfigError(f"hydra.sweep.subdir must be .NAME.STAMP.draft with a number as STAMP, got {draft.name!r}")
    return folders["name"]


def read_record(path: Path, *keys: str) -> dict[str, Any]:
    """What a job's JSON file says.

    Raises:
        DataError: It cannot be read, or lacks one of the keys.
    """
    record = json_in(read_text(path), path.name)
    if not isinstance(record, dict) or any(key not in record for key in keys):
        raise DataError(f"{path.name} must hold {', '.join(keys)}")
    return record


def read_job(folder: Path) -> dict[str, Any]:
    """The record of a finished job; where it is damaged, of a job that nobody looks for, with a warning."""
    try:
        record = read_record(folder / JOB, "overrides", "fingerprint")
        return record | {"overrides": [str(override) for override in record["overrides"]]}
    except (DataError, TypeError) as error:
        log.warning("%s counts for nothing: %s", folder, error)
        return {"overrides": [], "fingerprint": None}


class SweepFolder:
    """The folder of one sweep.

    Args:
        path: The folder; need not exist.
    """

    def __init__(self, path: Path) -> None:
        self.path = path

    def finished(self) -> Iterator[Path]:
        """The folders of the jobs that ended well."""
        if self.path.is_dir():
            for entry in self.path.iterdir():
                if not entry.name.startswith(".") and not entry.name.endswith(FAILED) and (entry / JOB).is_file():
                    yield entry

    def drafts(self) -> Iterator[Path]:
        """The folders of the jobs that run, or that were killed."""
        if self.path.is_dir():
            yield from (entry for entry in self.path.iterdir() if DRAFT.fullmatch(entry.name))

    def failures(self) -> list[Failure]:
        """The jobs that ended badly, in the order of their names."""
        folders = []
        for folder in self.path.glob(f"*{FAILED}"):
            try:
                record = read_record(folder / FAILURE, "overrides", "why")
                folders.append(Failure(folder, [str(o) for o in record["overrides"]], str(record["why"])))
            except (DataError, TypeError):  # there was no room for it
                folders.append(Failure(folder, [], "for a reason that could not be recorded"))
        return sorted(folders, key=lambda failure: (len(failure.folder.name), failure.folder.name))

    def find(self, config: SimulateSettings, name: str) -> Path | None:
        """The finished folder of a run of this configuration.

        Args:
            config: The settings.
            name: Where to look first; a sweep with other keys may have numbered its jobs differently.
        """
        wanted = fingerprint(config)
        first = self.path / name
        for folder in chain([first] if (first / JOB).is_file() else [], self.finished()):
            if read_job(folder)["fingerprint"] == wanted and _still_pruned(folder, config):
                return folder
        return None

    def publish(self, draft: Path, config: SimulateSettings, overrides: Sequence[str]) -> Path:
        """Renames a draft into place under its job's name, or the next free one; returns the new path."""
        name = job_name(draft)
        write_json(draft / JOB, {"name": name, "overrides": list(overrides), "fingerprint": fingerprint(config)})
        _discard(self.path / f"{name}{FAILED}")
        place, k = self.path / name, 1
        while True:
            try:
                # Onto a folder that is there and not empty this fails: nothing is ever written over.
                os.rename(draft, place)
                return place
            except OSError:
                if not place.exists():
                    raise
                k += 1
                place = self.path / f"{name}-{k}"

    def fail(self, draft: Path, overrides: Sequence[str], why: str) -> Failure:
        """Renames a draft to NAME.failed, with a record of why.

        Raises:
            OSError: There is no room for the record, though the draft is renamed; or it is not there.
        """
        place = self.path / f"{job_name(draft)}{FAILED}"
        try:
            write_json(draft / FAILURE, {"overrides": list(overrides), "why": why})
        finally:
            _discard(place)
            os.rename(draft, place)
        return Failure(place, list(overrides), why)

    def rename_job(self, folder: Path, overrides: Sequence[str]) -> None:
        """Notes how the sweep calls a finished job now, if an earlier one called it differently."""
        record = read_job(folder)
        if record["overrides"] != list(overrides):
            write_json(folder / JOB, {**record, "overrides": list(overrides)})

    def discard(self, draft: Path) -> None:
        """Removes a draft that is not needed."""
        _discard(draft)

    def clear(self) -> None:
        """Removes what killed and failed jobs left, before they are run again."""
        for folder in [*self.drafts(), *self.path.glob(f"*{FAILED}")]:
            _discard(folder)


def _still_pruned(folder: Path, config: SimulateSettings) -> bool:
    """Whether a finished run is what this configuration would leave: a run is pruned under certain settings only."""
    record = folder / PRUNED
    if not record.is_file():
        return True
    try:
        then = read_record(record)
    except DataError:
        return False  # it is run again
    return all(then.get(key) == value for key, value in pruning(config).items())


def _discard(folder: Path) -> None:
    # Out of sight first, as a whole: a late process finds no folder to write into or to rename.
    if folder.exists():
        out_of_sight = folder.with_name(f".{uuid.uuid4().hex}.discarded")
        os.rename(folder, out_of_sight)
        shutil.rmtree(out_of_sight, ignore_errors=True)
