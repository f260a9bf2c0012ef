"""One run of a report, and the files that a run's folder describes itself with."""

from __future__ import annotations

import os
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

from apcc_torch.errors import DataError
from apcc_torch.files import json_in, read_text, yaml_in
from apcc_torch.report.settings import flatten, scalar, split_overrides

COMPLETE, PRUNED, FAILED, UNFINISHED, BROKEN = "complete", "pruned", "failed", "unfinished", "broken"
"""What became of a run: a pruned one was given up by a search, a broken one has files that cannot be read."""

MOST_YAML = 2**22
"""Largest file of settings that is read, bytes; it takes a second."""


@dataclass(frozen=True)
class Run:
    """One run, or one point of a batch.

    name: Its folder, relative to what all given folders share.
    status: complete, pruned, failed, unfinished or broken.
    settings: Flat {key: value}.
    overrides: {key or group: text} of its command line.
    metrics: {name: number}.
    own: Keys that its batch swept.
    folder: Where its trajectory and figures are, if it has a folder.
    note: Why it is not complete, or what it lacks.
    versions: Of what it was computed with.
    """

    name: str
    status: str
    settings: Mapping[str, object] = field(default_factory=dict)
    overrides: Mapping[str, str] = field(default_factory=dict)
    metrics: Mapping[str, float] = field(default_factory=dict)
    own: tuple[str, ...] = ()
    folder: Path | None = None
    note: str = ""
    versions: Mapping[str, object] = field(default_factory=dict)


def there(path: Path) -> bool:
    """Whether there is anything of the name, if only a link to what is gone: it says why it cannot be read."""
    return os.path.lexists(path)


def load_yaml(path: Path) -> object:
    """The content of a YAML file.

    Raises:
        DataError: The file cannot be read, or is not plain YAML.
    """
    return yaml_in(read_text(path, MOST_YAML), path.name)


def read_json(path: Path) -> dict[str, object]:
    """A JSON file that holds a mapping.

    Raises:
        DataError: The file cannot be read, or holds something else.
    """
    data = json_in(read_text(path), path.name)
    if not isinstance(data, dict):
        raise DataError(f"{path.name} must hold values by name")
    return data


def read_metrics(path: Path) -> dict[str, float]:
    """{name: number} of a metrics.json.

    Raises:
        DataError: It cannot be read, or a value is not a number.
    """
    metrics: dict[str, float] = {}
    for name, value in read_json(path).items():
        if isinstance(value, bool) or not isinstance(value, int | float):
            said = repr(value) if isinstance(value, str | bool) else f"a {type(value).__name__}"
            raise DataError(f"{path.name} must hold numbers, but {name} is {said}")
        metrics[name] = float(value)
    return metrics


def read_versions(path: Path) -> dict[str, object]:
    """{name: text or number} of a versions.json; empty where there is none.

    Raises:
        DataError: It cannot be read.
    """
    told = read_json(path) if there(path) else {}
    return {name: version for name, version in told.items() if isinstance(version, str | int | float)}


def read_overrides(folder: Path) -> dict[str, str]:
    """{key or group: text} that hydra kept of the command line; empty without hydra."""
    path = folder / ".hydra" / "overrides.yaml"
    lines = load_yaml(path) if there(path) else []
    if not isinstance(lines, list):
        raise DataError("overrides.yaml must hold a list")
    return split_overrides([str(line) for line in lines])


def read_settings(folder: Path, overrides: Mapping[str, str]) -> dict[str, object]:
    """Flat settings: the resolved ones, else those hydra composed, else the overrides alone."""
    for path in (folder / "config.yaml", folder / ".hydra" / "config.yaml"):
        if there(path):
            tree = load_yaml(path)
            if not isinstance(tree, dict):
                raise DataError(f"{path.name} must hold settings by name")
            return flatten(tree)
    return {key: scalar(text) for key, text in overrides.items() if "." in key}
