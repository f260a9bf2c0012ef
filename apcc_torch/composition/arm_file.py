"""`arm=` on a command line: a name in conf/arm, or the path of an arm's file."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from typing import Any

from apcc_torch.errors import ConfigError
from apcc_torch.model.arm import Arm

SUFFIXES = (".yaml", ".yml", ".json")
"""Of files in which settings stand; identify's parameters.json is an arm's file too."""


def arm_override(arguments: Sequence[str]) -> list[str]:
    """Arguments as Hydra takes them: an arm's file is spelled out, `arm=FILE` becomes `~arm` and `arm={...}`.

    Keys of the arm may follow it, and several files make a sweep: arm=a.yaml,b.yaml. A value that ends in .yaml,
    .yml or .json is a file; any other is left to Hydra, as the name of an arm.

    Raises:
        ConfigError: Files and names are mixed.
        DataError: A file cannot be read.
        ConfigError, ValueRangeError: A file holds no arm.
    """
    words: list[str] = []
    for argument in arguments:
        paths = argument.removeprefix("arm=").split(",")
        files = [path for path in paths if path.endswith(SUFFIXES)]
        if not argument.startswith("arm=") or not files:
            words.append(argument)
            continue
        if files != paths:
            raise ConfigError(f"arm must name files or names, not both, got {argument}")
        arms = (Arm.load(path) for path in paths)
        words += ["~arm", "arm=" + ",".join(spelled(arm.entries()) for arm in arms)]
    return words


def literal(text: str) -> str:
    """A text as OmegaConf takes it: nothing in it refers to another value, or to the environment."""
    return re.sub(r"(\\*)\$\{", r"\1\1\\${", text)


def quoted(text: str) -> str:
    """A text within quotes, as Hydra's grammar has them: in front of a quote a backslash is an escape."""
    escaped = re.sub(r"(\\*)('|\Z)", lambda found: found[1] * 2 + ("\\'" if found[2] else ""), text)
    return f"'{escaped}'"


def spelled(value: Any) -> str:
    """A plain value in the grammar of Hydra's overrides, in which nothing is resolved.

    Raises:
        ConfigError: A name in it cannot be written so.
    """
    if isinstance(value, Mapping):
        for name in value:
            if not re.fullmatch(r"[\w.+%@?|/-]+( +[\w.+%@?|/-]+)*", str(name)):
                raise ConfigError(f"{str(name)!r} is no name that a setting can have: use letters, digits and _ . - /")
        return "{" + ",".join(f"{name}:{spelled(entry)}" for name, entry in value.items()) + "}"
    if isinstance(value, list):
        return "[" + ",".join(map(spelled, value)) + "]"
    if isinstance(value, str):
        return quoted(literal(value))
    return "null" if value is None else str(value).lower() if isinstance(value, bool) else repr(value)
