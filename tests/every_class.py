"""All classes of the package below a base."""

from __future__ import annotations

import importlib
import pkgutil
from functools import cache
from typing import Any

import apcc_torch

PROGRAMS = {"benchmark", "identify", "robot", "robot_log", "simulate", "__main__"}
"""Modules that start Hydra when they are imported, or run."""


@cache
def load() -> None:
    """Imports every module of the package."""
    for found in pkgutil.walk_packages(apcc_torch.__path__, "apcc_torch."):
        if found.name.rpartition(".")[2] not in PROGRAMS:
            importlib.import_module(found.name)


def subclasses(base: type[Any]) -> list[type[Any]]:
    """All classes below `base` that the package defines, by name."""
    load()
    below: dict[type[Any], None] = {}
    waiting = [base]
    while waiting:
        for each in waiting.pop().__subclasses__():
            if each not in below:
                below[each] = None
                waiting.append(each)
    own = (each for each in below if each.__module__.startswith("apcc_torch."))
    return sorted(own, key=lambda each: (each.__module__, each.__qualname__))
