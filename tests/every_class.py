"""All classes of the package below a base, and values for settings that need some."""

from __future__ import annotations

import importlib
import pkgutil
from dataclasses import MISSING, fields
from functools import cache
from typing import Any

import apcc_torch
from apcc_torch.settings import Settings, default_of

PROGRAMS = {"benchmark", "evaluate", "export", "identify", "robot", "robot_log", "simulate", "__main__"}
"""Modules that start Hydra when they are imported, or run."""

NEEDED: dict[str, Any] = {
    "DynamicSettings.control_rate": 100.0,
    "DynamicSettings.duration": 1.0,
    "DynamixelSettings.ids": (1, 2),
    "DynamixelSettings.lower": -0.02,
    "DynamixelSettings.port": "/dev/ttyUSB0",
    "ExperimentSettings.kind": "dynamic",
    "ExperimentSettings.name": "a_run",
    "GridSettings.name": "small",
    "FeetechSettings.ids": (1, 2),
    "FeetechSettings.lower": -0.02,
    "FeetechSettings.port": "/dev/ttyACM0",
    "GripperSettings.id": 7,
    "PairSettings.adaptive": "dynamic_run_1",
    "PairSettings.standard": "dynamic_run_2",
    "RegulatorSettings.commands": (0, 1),
    "RegulatorSettings.host": "127.0.0.1",
    "RegulatorSettings.readings": (0, 1),
    "RegulatorSettings.upper": 1e5,
    "ServoSettings.ids": (1, 2),
    "ServoSettings.lower": -0.02,
    "ServoSettings.port": "/dev/ttyUSB0",
    "lengths": (0.2, 0.25),
}
"""What settings that have to be given are in tests, by their class and name, or by name alone."""


@cache
def load() -> None:
    """Imports every module of the package."""
    for found in pkgutil.walk_packages(apcc_torch.__path__, "apcc_torch."):
        if found.name.split(".")[1] not in PROGRAMS and not found.name.endswith("__main__"):
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


def settings_classes() -> list[type[Settings]]:
    """All classes of settings that have some."""
    return [kind for kind in subclasses(Settings) if fields(kind)]


def needed(kind: type[Settings]) -> dict[str, Any]:
    """Values for the settings of a class that have no default."""
    values = {}
    for each in fields(kind):
        if default_of(each) is MISSING:
            value = NEEDED.get(f"{kind.__name__}.{each.name}", NEEDED.get(each.name))
            nested = next((one for one in settings_classes() if one.__name__ == each.type), None)
            values[each.name] = value if nested is None else nested(**needed(nested))
    return values
