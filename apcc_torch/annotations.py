"""What the annotation of a setting allows: the check of a value's type, with its message, and the numbers in it."""

from __future__ import annotations

import re
import sys
from collections.abc import Iterable, Mapping, Sequence
from functools import cache
from typing import Any

import numpy as np
import torch
from torch import Tensor

from apcc_torch.errors import ConfigError
from apcc_torch.modes import values_of
from apcc_torch.spread import is_profile

_WORDS = {
    "bool": "true or false",
    "int": "a whole number",
    "str": "a text",
    "float": "a number",
    "Numbers": "a number, a list of numbers or [along, ...]",
    "floats": "a list of numbers",
    "ints": "a list of whole numbers",
    "strs": "a list of texts",
    "list": "a list",
    "Mapping": "a mapping",
}
_ALIASES = {
    "Setting": ("float", "Tensor"),
    "Lengths": ("floats", "Tensor"),
    "Points": ("list", "Tensor"),
    "Range": (),
    "Strains": ("list",),
    "Table": ("list", "Tensor"),
    "Any": (),
}
"""Names of types that settings are annotated with, and what they stand for."""


@cache
def _kinds(annotation: str) -> tuple[str, ...]:
    """What an annotation allows, in the words of `_is`; () for anything."""
    allowed: dict[str, None] = {}
    for part in re.split(r"\|(?![^\[]*\])", annotation.replace(" ", "")):
        name, _, inner = part.partition("[")
        entry = inner.partition(",")[0].rstrip("]")
        if name == "tuple":
            kinds: tuple[str, ...] = (f"{entry}s" if f"{entry}s" in _WORDS else "list",)
        else:
            kinds = _ALIASES.get(name, ("Mapping" if name == "dict" else name,))
        if not kinds:
            return ()
        allowed.update(dict.fromkeys(kinds))
    return tuple(allowed)


def check_type(key: str, value: Any, annotation: str) -> None:
    """Raises ConfigError where a value is of none of the types of its annotation."""
    allowed = _kinds(annotation)
    if allowed and not any(_is(value, kind) for kind in allowed):
        told = sorted(_WORDS.get(kind, kind) for kind in allowed if kind not in ("None", "Tensor"))
        raise ConfigError(f"{key} must be {' or '.join(told)}, got {shown(value)}")


def named(annotation: Any) -> str:
    """The text of an annotation that Python has made an object of, as it does without `annotations` of __future__."""
    return annotation.__name__ if isinstance(annotation, type) else str(annotation)


def _is(value: Any, kind: str) -> bool:
    if isinstance(value, np.ndarray | np.generic):
        value = value.tolist()
    if kind in ("float", "int"):
        return isinstance(value, int if kind == "int" else int | float) and not isinstance(value, bool)
    if kind in ("bool", "str"):
        return isinstance(value, bool if kind == "bool" else str)
    if kind == "None":
        return value is None
    if kind == "Tensor":
        return isinstance(value, Tensor) and value.dtype != torch.bool and not value.is_complex()
    if kind == "Numbers":
        return _are_numbers(value)
    if kind == "Mapping":
        return isinstance(value, Mapping)
    if kind in ("floats", "ints", "strs", "list"):
        return isinstance(value, list | tuple) and (kind == "list" or all(_is(each, kind[:-1]) for each in value))
    return any(base.__name__ == kind for base in type(value).__mro__)


def _are_numbers(value: Any) -> bool:
    """Whether a value is a number, a tensor, a profile, or lists of numbers."""
    if isinstance(value, np.ndarray):
        value = value.tolist()
    if isinstance(value, list | tuple):
        return len(value) > 0 and all(map(_are_numbers, value[1:] if is_profile(value) else value))
    return _is(value, "float") or _is(value, "Tensor")


def shown(value: Any) -> str:
    """A value in a message: not more of it than a line."""
    told = repr(value)
    return told if len(told) <= 80 else f"{told[:60]}..."


def is_finite(number: float) -> bool:
    """Whether a number is neither infinite nor NaN, nor a whole number above every float."""
    return abs(number) <= sys.float_info.max


def numbers_in(value: Any) -> Iterable[float]:
    """Every number in a number, a tensor, or lists and mappings of them; none of a tensor without values to read."""
    if isinstance(value, Tensor):
        yield from values_of(value.detach().flatten()) or ()
    elif isinstance(value, Mapping):
        for entry in value.values():
            yield from numbers_in(entry)
    elif isinstance(value, Sequence) and not isinstance(value, str):
        for entry in value:
            yield from numbers_in(entry)
    elif isinstance(value, int | float) and not isinstance(value, bool):
        yield value
