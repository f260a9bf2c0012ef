"""Plain values to settings and back: what a file or a command line says, checked key by key against the dataclasses."""

from __future__ import annotations

import typing
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import MISSING, Field, fields, is_dataclass
from types import UnionType
from typing import Any, TypeVar, Union, cast

from torch import Tensor

from apcc_torch.annotations import is_finite, shown
from apcc_torch.classes import Trust, class_named, name_of
from apcc_torch.errors import ApccError, Checks, ConfigError, begun_with
from apcc_torch.part import part_of
from apcc_torch.settings import Settings, about_of, check_field, default_of, did_you_mean, differs, keys, names

Root = TypeVar("Root", bound=Settings)

MUST = "???"
"""What stands for a value that has to be given, as in OmegaConf."""


def read(
    values: Mapping[str, Any], root: type[Root], key: str = "", trust: Trust = Trust.ANY, start: Root | None = None
) -> Root:
    """Settings of the class `root` from plain values; what is left out has its default.

    A field whose `About.base` is a class holds a part: its value is a mapping with `kind`, the part's class, and that
    class's own settings; without a `kind` the part is the field's default. None, a `kind` of None and an empty mapping
    stand for no part, where the field allows it.

    Args:
        values: Nested mappings, as a file or a command line gives them.
        root: A `Settings` class.
        key: Where in the whole the values stand, for messages; "" for the root.
        trust: Which classes a `kind` may name.
        start: Where what is left out comes from; None: the defaults of the class.

    Raises:
        ConfigError: A key is unknown or missing, or a value has the wrong type; the sentence names the key.
        ValueRangeError: A number is out of its range.
        MismatchError: Several of these.
    """
    if not isinstance(values, Mapping):
        raise ConfigError(f"{key or 'the settings'} must hold keys and values, got {shown(values)}")
    checks = Checks()
    for name in values:
        with checks.one():
            check_key(str(name), root, key)
    # What only code may set comes along where values start from settings.
    taken = {} if start is None else {name: getattr(start, name) for name in names(root)}
    for each in keys(root):
        at, default = _join(key, each.name), default_of(each) if start is None else getattr(start, each.name)
        with checks.one():
            if each.name in values and values[each.name] != MUST:
                taken[each.name] = _value(values[each.name], each, root, at, trust, default)
            elif default is MISSING:
                raise ConfigError(f"{at} must be given")
            else:
                taken[each.name] = default
    if not checks.errors:
        with keyed(key):
            return root(**taken)
    for each in keys(root):  # what the others hold is told with them
        if taken.get(each.name) is not None:
            with checks.one(), keyed(key):
                check_field(each, taken[each.name])
    checks.end()
    raise AssertionError("unreachable: a check has failed")


def check_key(name: str, root: type[Settings], key: str = "") -> None:
    """Raises ConfigError where a class of settings, which stand at `key`, has none of that name."""
    known = [each.name for each in keys(root)]
    if name in root.elsewhere:
        raise ConfigError(f"{_join(key, name)} is no setting here, but one of {root.elsewhere[name]}")
    if name not in known:
        said = _join(key, name)  # of a file, it may be any text
        raise ConfigError(f"{said if said.isprintable() else repr(said)} is no setting{did_you_mean(name, known)}")


@contextmanager
def keyed(key: str) -> Iterator[None]:
    """Where a part refuses one of its own settings, the sentence names it by the key it has in the whole."""
    try:
        yield
    except ApccError as error:
        raise begun_with(_join(key, ""), error) from error


def _value(value: Any, each: Field[Any], root: type[Settings], key: str, trust: Trust, default: Any) -> Any:
    about, annotation = about_of(each), _types(root)[each.name]
    if about.base is not None:
        part = None if default is MISSING else default
        if value is None or (isinstance(value, Mapping) and value.get("kind", MUST if value or part else None) is None):
            unread = [name for name in value or () if name != "kind"]
            if unread:
                raise ConfigError(
                    f"{_join(key, unread[0])} is read by nothing: there is no {each.name} here, choose one"
                )
            return None
        return read_part(value, about.base, key, trust, part)
    options, nested = _options(annotation), nested_in(root, each.name)
    if value is None and type(None) in options:
        return None
    if nested is not None:
        if type(None) in options and isinstance(value, Mapping) and not value and default is None:
            return None  # a part that may be left out is there once it has a key
        return read(value, nested, key, trust, default if isinstance(default, nested) else None)
    for option in options:
        origin, inner = typing.get_origin(option), typing.get_args(option)
        if origin is dict and is_dataclass(inner[1]) and isinstance(value, Mapping):
            kind = cast(type[Settings], inner[1])
            return {str(name): read(entry, kind, _join(key, str(name)), trust) for name, entry in value.items()}
        if origin is tuple and float not in options:
            return _entries(value, inner[0], key)
    # YAML tells 2 from 2.0, and a setting that is a number does not.
    if isinstance(value, int) and not isinstance(value, bool) and float in options and int not in options:
        return _number(value)
    return value


def _options(annotation: Any) -> tuple[Any, ...]:
    return typing.get_args(annotation) if typing.get_origin(annotation) in (Union, UnionType) else (annotation,)


def nested_in(root: type[Settings], name: str) -> type[Settings] | None:
    """The class of the settings that a field holds, which may be left out; None of a value, or a part by its class."""
    if any(about_of(each).base is not None for each in fields(root) if each.name == name):
        return None
    options = _options(_types(root)[name])
    if any(typing.get_origin(option) is Mapping for option in options):
        return None  # plain keys, which the field's owner reads
    return next((cast(type[Settings], option) for option in options if is_dataclass(option)), None)


def _entries(value: Any, inner: Any, key: str) -> tuple[Any, ...]:
    if isinstance(value, str) or not isinstance(value, Sequence):
        raise ConfigError(f"{key} must be a list, got {shown(value)}")
    if inner in (float, int, str):
        wanted = {float: (int, float), int: (int,), str: (str,)}[inner]
        word = {float: "numbers", int: "whole numbers", str: "texts"}[inner]
        if any(isinstance(entry, bool) or not isinstance(entry, wanted) for entry in value):
            raise ConfigError(f"{key} must be a list of {word}, got {shown(list(value))}")
        return tuple(_number(entry) if inner is float else entry for entry in value)
    return tuple(value)


def _number(value: float) -> float:
    """As a float, where it is not above all of them: the settings themselves refuse that."""
    return float(value) if is_finite(value) else value


def read_part(values: Any, base: type, key: str, trust: Trust = Trust.ANY, default: Any = None) -> Settings:
    """The settings of the part that `values` name by their `kind`; those of `default`, changed, where they name none.

    Raises:
        ConfigError: No class is named, it is not of `base`, or it has no such settings.
    """
    if isinstance(values, Mapping) and "kind" not in values and isinstance(default, Settings):
        return read(values, type(default), key, trust, default)
    if not isinstance(values, Mapping) or not isinstance(values.get("kind"), str) or values["kind"] == MUST:
        raise ConfigError(f"{_join(key, 'kind')} must name a class, as package.module.Class")
    part = class_named(_join(key, "kind"), values["kind"], base, trust)
    settings: type[Settings] = part.settings_type
    return read({name: value for name, value in values.items() if name != "kind"}, settings, key, trust)


def plain(settings: Any) -> Any:
    """Settings as plain values that `read` takes: mappings, lists, numbers and texts."""
    if is_dataclass(settings) and not isinstance(settings, type):
        return {each.name: _plain_field(each, getattr(settings, each.name)) for each in keys(type(settings))}
    if isinstance(settings, Mapping):
        return {name: plain(value) for name, value in settings.items()}
    if isinstance(settings, list | tuple):
        return [plain(value) for value in settings]
    return settings.tolist() if isinstance(settings, Tensor) else settings


def _plain_field(each: Field[Any], value: Any) -> Any:
    """A field's plain value; of a part with its class."""
    if about_of(each).base is None or value is None:
        return plain(value)
    return {"kind": name_of(part_of(value)), **plain(value)}


def deviations(settings: Settings) -> dict[str, Any]:
    """Settings that differ from their defaults, as plain values that `read` takes."""
    values = {}
    for each in keys(type(settings)):
        value = getattr(settings, each.name)
        if differs(each, value):
            nested = isinstance(value, Settings) and about_of(each).base is None
            values[each.name] = deviations(value) if nested else _plain_field(each, value)
    return values


def defaults(root: type[Settings]) -> dict[str, Any]:
    """The defaults of a `Settings` class as plain values; `MUST` where there is none."""
    values: dict[str, Any] = {}
    for each in keys(root):
        default = default_of(each)
        if default is MISSING:
            annotation = _types(root)[each.name]
            values[each.name] = defaults(cast(type[Settings], annotation)) if is_dataclass(annotation) else MUST
        else:
            values[each.name] = _plain_field(each, default)
    return values


_TYPES: dict[Any, dict[str, Any]] = {}


def _types(root: type[Settings]) -> dict[str, Any]:
    if root not in _TYPES:
        _TYPES[root] = typing.get_type_hints(root)
    return _TYPES[root]


def _join(key: str, name: str) -> str:
    return f"{key}.{name}" if key else name
