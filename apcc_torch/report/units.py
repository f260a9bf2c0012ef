"""What a column of a report is called, and the unit of its numbers."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from functools import cache
from typing import Any, NamedTuple

from apcc_torch.composition.help import rows
from apcc_torch.composition.run_settings import SimulateSettings
from apcc_torch.settings import about_of, keys

METRIC_UNITS = {"mm": "mm", "cm": "cm", "m": "m", "s": "s", "rad": "rad", "kg": "kg", "g": "g", "hz": "Hz"} | {
    "ms": "ms", "mmps": "mm/s", "n": "N", "nm2": "N m²", "nspm": "N s/m"
}  # fmt: skip
"""The last part of a metric's name -> its unit."""


@cache
def key_units() -> dict[str, str]:
    """Configuration key -> unit, as the settings themselves tell it; of parts named by class, those of every class."""
    units = {row.key: row.unit for row in rows(SimulateSettings)}
    for each in keys(SimulateSettings):
        base = about_of(each).base
        for part in () if base is None else (base, *_subclasses(base)):
            if part.settings_type is not None:
                units |= {row.key: row.unit for row in rows(part.settings_type, f"{each.name}.")}
    return units


def _subclasses(base: Any) -> Iterator[Any]:
    for part in base.__subclasses__():
        if part.__module__ in sys.modules:  # a module that was unloaded takes the names of its settings' types along
            yield part
            yield from _subclasses(part)


class Label(NamedTuple):
    """How a column is headed: words, and a unit, "" without one."""

    words: str
    unit: str


def metric_label(name: str) -> Label:
    """ "shape_error_mean_mm" -> ("shape error mean", "mm")."""
    *parts, last = name.split("_")
    if parts and last in METRIC_UNITS:
        return Label(" ".join(parts), METRIC_UNITS[last])
    return Label(name.replace("_", " "), "")


def key_label(key: str) -> Label:
    """A configuration key as it is, with its unit where it has one."""
    return Label(key, key_units().get(key, ""))
