"""Numbers of a preset that were chosen for one arm, and go in proportion with any other.

A list that begins with "on ARM" holds such numbers: `elongation_bound: [on arm_1, 0.08]` is 0.08 m on arm 1, and as
much of its length on another arm; `K_P: [on arm_1]` is the key's default, likewise. What a number is proportional to
follows from its unit.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import cache
from math import log2
from typing import Any

from apcc_torch.classes import class_named
from apcc_torch.errors import Checks, ConfigError
from apcc_torch.model import arm_scale
from apcc_torch.model.arm import Arm
from apcc_torch.reading import MUST, nested_in, plain, read
from apcc_torch.settings import About, Settings, about_of, default_of, keys

HEAD = "on "
"""How the first entry of such a list begins."""

PROPORTIONAL: dict[str, Callable[[Arm], float]] = {
    "m": arm_scale.length,
    "m/rad": arm_scale.length,
    "m/s": arm_scale.length,
    "1/s": lambda arm: _pace(arm),
    # In doublings, so that runs of arms which differ little are as long and share a batch.
    "s": lambda arm: 2.0 ** round(-log2(_pace(arm))),
    "kg": arm_scale.largest_payload,
    "N": arm_scale.tendon_force,
    "N/m": arm_scale.tendon_stiffness,
    "N/(m s)": arm_scale.tendon_stiffness,
    "N s/m": arm_scale.tendon_damping,
}
"""A unit -> what of an arm its numbers go with."""


def _pace(arm: Arm) -> float:
    """How fast an arm may be driven beside arm 1: a slow one as it swings, none faster, for sensors are no faster."""
    return min(arm_scale.rate(arm) / _rate(), 1.0)


@cache
def _rate() -> float:
    return arm_scale.rate(_named("arm_1"))


def in_proportion(values: dict[str, Any], root: type[Settings]) -> dict[str, Any]:
    """Composed values with the numbers of other arms as they are on theirs.

    Args:
        values: Of a whole, its arm among them.
        root: Its class.

    Raises:
        ConfigError: A list names no arm, or its numbers go with nothing of an arm.
    """
    if not isinstance(values.get("arm"), Mapping):
        return values
    arm: list[Arm] = []  # read once it is needed
    sizes: dict[str, float] = {}  # of that arm, by unit
    refusals = Checks()

    def scaled(key: str, about: About, value: list[Any], default: Any) -> Any:
        if about.unit not in PROPORTIONAL:
            raise ConfigError(f"{key} goes with nothing of an arm: give it as a number, without {value[0]!r}")
        if not arm:
            with refusals.one():
                arm.append(read(values["arm"], Arm, "arm"))
        if arm and about.unit not in sizes:
            sizes[about.unit] = PROPORTIONAL[about.unit](arm[0])
        # What is no arm is refused where all is read, with whatever else does not fit.
        ratio = 1.0 if refusals.errors else sizes[about.unit] / _size(value[0].removeprefix(HEAD).strip(), about.unit)
        numbers = value[1:]
        if not numbers:
            return _times(plain(default), ratio)
        return _times(numbers[0] if _is_number(numbers) and not isinstance(default, list | tuple) else numbers, ratio)

    def walked(inner: Mapping[str, Any], kind: type[Settings], path: str) -> dict[str, Any]:
        known, later = {each.name: each for each in keys(kind)}, dict(inner)
        for name, value in inner.items():
            if name not in known:
                continue
            key, about = f"{path}{name}", about_of(known[name])
            if isinstance(value, list) and value and isinstance(value[0], str) and value[0].startswith(HEAD):
                later[name] = scaled(key, about, value, default_of(known[name]))
            elif isinstance(value, Mapping) and (nested := _kind(value, kind, name, key)) is not None:
                later[name] = walked(value, nested, f"{key}.")
        return later

    return walked(values, root, "")


def _kind(value: Mapping[str, Any], kind: type[Settings], name: str, key: str) -> type[Settings] | None:
    """The class of the settings that a field's mapping stands for; None where it is none."""
    each = next(each for each in keys(kind) if each.name == name)
    base, default = about_of(each).base, default_of(each)
    if base is None:
        return nested_in(kind, name)
    if isinstance(value.get("kind"), str) and value["kind"] != MUST:
        return class_named(f"{key}.kind", value["kind"], base).settings_type
    return type(default) if isinstance(default, Settings) else None


@cache
def _named(name: str) -> Arm:
    return Arm.load(name)


@cache
def _size(name: str, unit: str) -> float:
    return PROPORTIONAL[unit](_named(name))


def _is_number(numbers: list[Any]) -> bool:
    return len(numbers) == 1 and isinstance(numbers[0], int | float)


def _times(value: Any, ratio: float) -> Any:
    if isinstance(value, list):
        return [_times(entry, ratio) for entry in value]
    if not isinstance(value, int | float) or isinstance(value, bool) or ratio == 1.0:
        return value
    return float(f"{value * ratio:.9g}")  # as a person would write it
