"""What a column of a report is called, and the unit of its numbers."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import fields
from typing import NamedTuple

from apcc_torch.classes import Trust, class_named
from apcc_torch.composition.run_settings import SimulateSettings
from apcc_torch.errors import ConfigError
from apcc_torch.reading import nested_in
from apcc_torch.settings import Settings, about_of

METRIC_UNITS = {"mm": "mm", "cm": "cm", "m": "m", "s": "s", "rad": "rad", "kg": "kg", "g": "g", "hz": "Hz"} | {
    "n": "N", "nm2": "N m²", "nspm": "N s/m"
}  # fmt: skip
"""The last part of a metric's name -> its unit."""


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


def key_label(key: str, runs: Sequence[Mapping[str, object]] = ()) -> Label:
    """A configuration key as it is, with its unit where it has one.

    Args:
        key: Of a simulation.
        runs: Flat settings of the runs, which name the classes of parts.
    """
    return Label(key, next(filter(None, (unit_of(key, run) for run in runs or ({},))), ""))


def unit_of(key: str, run: Mapping[str, object]) -> str:
    """The unit of a key in a run's flat settings; "" where it has none, or belongs to a class that is not ours."""
    kind: type[Settings] | None = SimulateSettings
    path = key.split(".")
    for depth, name in enumerate(path):
        field = {each.name: each for each in fields(kind)}.get(name)
        if field is None:
            return ""
        about = about_of(field)
        if depth == len(path) - 1:
            return about.unit.replace("^2", "²")
        kind = nested_in(kind, name)
        if kind is None:
            told = run.get(".".join([*path[: depth + 1], "kind"]))
            if about.base is None or not isinstance(told, str):
                return ""
            try:
                kind = class_named(key, told, about.base, Trust.OWN).settings_type
            except ConfigError:
                return ""
    return ""
