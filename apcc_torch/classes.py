"""Parts by the name of their class: any class from this package or another, or only those that a file may name."""

from __future__ import annotations

import sys
from enum import Enum
from importlib import import_module
from inspect import isabstract
from pathlib import Path
from typing import Any

from apcc_torch.errors import ConfigError

PACKAGE = "apcc_torch."


class Trust(Enum):
    """Which classes may be named: whatever a user types, or only this package's, in a file that came from elsewhere."""

    ANY = "any"
    OWN = "own"


ALLOWED: set[str] = set()
"""Full names of classes from elsewhere that files may name too; a program adds them when its user asks for it."""


def class_named(key: str, name: str, base: type, trust: Trust = Trust.ANY) -> Any:
    """The class of a full name.

    Args:
        key: The setting that names it, for messages.
        name: As package.module.Class. A module in the working folder is found too.
        base: What it has to be a subclass of.
        trust: Which names are taken at all; nothing is imported for one that is not.

    Raises:
        ConfigError: There is no such class, it is not of `base`, lacks a method, or is not trusted.
    """
    check_trusted(key, name, trust)
    module, _, attribute = name.rpartition(".")
    here = str(Path.cwd())
    if not name.startswith(PACKAGE) and here not in sys.path and "" not in sys.path:
        # A console script does not look there, and `python -m` does.
        sys.path.append(here)
    try:
        named = getattr(import_module(module), attribute)
    except (ImportError, AttributeError, ValueError) as error:
        raise ConfigError(f"{key} must be a class, as package.module.Class, got {name!r}: {error}") from error
    if not (isinstance(named, type) and issubclass(named, base)):
        raise ConfigError(f"{key} must be a {base.__name__}, got {name!r}")
    if isabstract(named):
        lacking = ", ".join(sorted(getattr(named, "__abstractmethods__", ())))
        raise ConfigError(f"{key} must be a class that is complete, and {name} lacks {lacking}")
    return named


def check_trusted(key: str, name: str, trust: Trust) -> None:
    """Raises ConfigError where a file from elsewhere names a class of elsewhere, and nobody has allowed it."""
    if trust is Trust.OWN and not name.startswith(PACKAGE) and name not in ALLOWED:
        raise ConfigError(
            f"{key} names {name}, which is not of this package: a file may name it only where you allow it, with "
            f"--allow-class {name}"
        )


def name_of(part: type) -> str:
    """The full name of a class, which `class_named` takes."""
    return f"{part.__module__}.{part.__qualname__}"
