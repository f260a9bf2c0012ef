"""Settings of runs as flat {key: value}, and which of them a set of runs sweeps."""

from __future__ import annotations

import json
import re
from collections.abc import Mapping, Sequence
from functools import lru_cache

from apcc_torch.errors import DataError
from apcc_torch.files import yaml_in

POWER = re.compile(r"[+-]?(\d+\.?\d*|\.\d+)[eE][+-]?\d+")

NAME = "experiment.name"
"""The setting that names a run's experiment, which chooses most of the others."""
HOW = ("batch", "figures", "hydra", "jobs", "objective", "overwrite", "progress", "prune", "resume", "sweep", "threads")
"""Keys, and first parts of keys, that say how runs are computed, not what is computed: no setting to compare."""


@lru_cache(maxsize=65536)
def scalar(text: str) -> object:
    """The value that an override's text stands for: numbers as numbers, lists as lists, else the text.

    YAML 1.1 takes 1e-3 for a text; here it is a number.
    """
    if POWER.fullmatch(text):
        return float(text)
    try:
        return yaml_in(text, "")
    except DataError:
        return text


def flatten(tree: Mapping[str, object], prefix: str = "") -> dict[str, object]:
    """{"a": {"b": 1}} -> {"a.b": 1}; a list is one value."""
    flat: dict[str, object] = {}
    for key, value in tree.items():
        name = f"{prefix}{key}"
        if isinstance(value, Mapping):
            flat |= flatten(value, name + ".")
        else:
            flat[name] = value
    return flat


def split_overrides(lines: Sequence[str]) -> dict[str, str]:
    """Hydra's overrides as {key or group: text}: "+a.b=1" -> {"a.b": "1"}; deletions are left out."""
    pairs = (line.partition("=") for line in lines if "=" in line and not line.startswith("~"))
    return {key.lstrip("+").partition("@")[0]: text for key, _, text in pairs}


def comparable(value: object) -> object:
    """A hashable stand-in that is equal for equal settings: 1 and 1.0 are the same, 1 and true are not."""
    if isinstance(value, bool):
        return ("bool", value)
    if isinstance(value, float) and value != value:
        return ("nan",)
    if isinstance(value, list | tuple):
        return tuple(comparable(entry) for entry in value)
    return value


def text_of(value: object) -> str:
    """A setting as text for people: true, 0.3, pose, [0.1, 0.2]; "" for null."""
    if value is None:
        return ""
    if isinstance(value, str):
        return value
    try:
        return json.dumps(value, default=str)
    except TypeError:  # a date that names a value
        return str(value)


def is_how(key: str) -> bool:
    """Whether the key says only how runs are computed; batch_kept and the like do as batch does."""
    return re.split(r"[./_]", key)[0] in HOW


def swept_keys(
    settings: Sequence[Mapping[str, object]], overrides: Sequence[Mapping[str, str]], own: Sequence[str] = ()
) -> list[str]:
    """The keys that tell the runs apart or were overridden, in the order of the settings.

    A group that was chosen (experiment=kinematic) is one key, and the settings that merely follow from the choices are
    not listed beside it; what follows from experiment.name is not either.

    Args:
        settings: Flat settings, one mapping a run.
        overrides: {key or group: text}, one mapping a run.
        own: Keys that are swept whatever their values.
    """
    known: dict[str, None] = dict.fromkeys(key for run in settings for key in run)
    folders = {key[:k] for key in known for k, letter in enumerate(key) if letter == "."}
    named = dict.fromkeys(key for run in overrides for key in run if not is_how(key))
    # A part that some runs lack is a value there and a group elsewhere.
    groups = [key for key in named if key not in known or key in folders]
    choices = [tuple(run.get(group) for group in groups) for run in overrides]
    named_choices = [(*choice, str(run.get(NAME))) for choice, run in zip(choices, settings, strict=True)]
    chosen = {*named, *own}
    swept = [
        group for group in groups if group in folders or "/" in group or len({r.get(group) for r in overrides}) > 1
    ]
    for key in known:
        if is_how(key) or key in folders:
            continue
        if key in chosen or _varies(key, settings, choices if key == NAME else named_choices):
            swept.append(key)
    return swept


def _varies(key: str, settings: Sequence[Mapping[str, object]], choices: Sequence[tuple[str | None, ...]]) -> bool:
    """Whether the key has two values among runs of equal choices."""
    first: dict[tuple[str | None, ...], object] = {}
    for run, choice in zip(settings, choices, strict=True):
        # A part that is not there has no class, and no settings that could differ.
        if key in run or key.endswith(".kind"):
            value = comparable(run.get(key))
            if first.setdefault(choice, value) != value:
                return True
    return False
