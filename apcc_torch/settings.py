"""Settings: what a part can be set to, told once, in one frozen dataclass beside the part.

A field holds its default, and with it its unit, where it comes from, what it means, its range, and whether it may
differ from row to row of a batch. Whatever else needs these reads them here: the command line's keys and `--help`, the
axis of a batch, `repr`, `state_dict` and the tables of the documentation.
"""

from __future__ import annotations

import dataclasses
import difflib
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import MISSING, dataclass, field, fields
from math import pi
from typing import Any, ClassVar, NamedTuple, Self, TypeVar

import torch
from torch import Tensor

from apcc_torch.annotations import check_type, is_finite, named, numbers_in, shown
from apcc_torch.errors import Checks, ConfigError, ValueRangeError

Setting = float | Tensor
"""A number for all rows, or (...) numbers that broadcast with the leading dimensions of what they are used on."""

MANY = 10_000
"""The most of what is counted, where each takes memory or time."""

TURN = 2.0 * pi
"""A full turn, rad: no angle that is a place around the backbone is larger."""

PAPER, OURS = "paper", "ours"
"""Where a default comes from: the paper, or a choice that the paper leaves open."""

Value = TypeVar("Value")


class About(NamedTuple):
    """What is known of a setting beside its default.

    unit: SI, "" for none. source: `PAPER` or `OURS`. meaning: One line, no full stop.
    rows: How it may differ from row to row: "" not at all; "number"; "gain", a matrix for the tip ("task") or the
        sections; "sections", one a section; "points", a list of lists.
    apart: Whether zero is no number like others, so that rows with and without it share no batch.
    above, least, below, most: Range of every number in it, open and closed at the lower and at the upper end.
    infinite: Whether a number in it may be infinite; else all are finite, with a range or without.
    choices: What a text may be; () for any.
    base: The class that a part named by `kind` has to be of; None where no part is named.
    key: Whether files and command lines may set it too, or code alone.
    """

    unit: str = ""
    source: str = OURS
    meaning: str = ""
    rows: str = ""
    apart: bool = False
    above: float | None = None
    least: float | None = None
    below: float | None = None
    most: float | None = None
    infinite: bool = False
    choices: tuple[str, ...] = ()
    base: type | None = None
    key: bool = True

    def check(self, key: str, value: Any) -> None:
        """Raises ValueRangeError where a number, or one of those in lists and tensors, is out of range."""
        if self.choices:
            check_choice(key, value, self.choices)
        for number in numbers_in(value):
            inside = (
                (self.above is None or number > self.above)
                and (self.least is None or number >= self.least)
                and (self.below is None or number < self.below)
                and (self.most is None or number <= self.most)
            )
            if not inside or not (self.infinite or is_finite(number)):
                raise ValueRangeError(f"{key} must be {self.range}, got {shown(number)}")

    @property
    def range(self) -> str:
        """The range in words."""
        if self.below is self.most is None:
            finite = "" if self.infinite else " and finite"
            low = self.least if self.above is None else self.above
            if low is None:
                return finite.removeprefix(" and ") or "a number"
            if low == 0:
                return f"{'' if self.above == 0 else 'zero or '}positive{finite}"
            return f"{'at least' if self.above is None else 'above'} {low:g}{finite}"
        if self.above is self.least is None:
            return f"at most {self.most:g}" if self.below is None else f"below {self.below:g}"
        begin = f"({self.above:g}" if self.least is None else f"[{self.least:g}"
        return f"in {begin}, " + (f"{self.most:g}]" if self.below is None else f"{self.below:g})")


def setting(
    default: Any = MISSING,
    unit: str = "",
    source: str = OURS,
    meaning: str = "",
    *,
    factory: Any = MISSING,
    **about: Any,
) -> Any:
    """A field of a `Settings` class; `about` as `About`. Without a default or factory it has to be given.

    Example:
        >>> from dataclasses import dataclass
        >>> @dataclass(frozen=True, kw_only=True)
        ... class LeakSettings(Settings):
        ...     time: float = setting(2.0, "s", meaning="in which the estimate leaks away", above=0)
        >>> LeakSettings(time=3.0)
        LeakSettings(time=3.0)
    """
    metadata = {"about": About(unit, source, meaning, **about)}
    if factory is not MISSING:
        return field(default_factory=factory, metadata=metadata)
    return field(default=default, metadata=metadata)


@dataclass(frozen=True, kw_only=True)
class Settings:
    """Base of all settings: every number is checked against its range when they are made.

    Raises:
        ConfigError: A value is of the wrong type, or none of a field's choices.
        ValueRangeError: A number is out of its range.
        MismatchError: Several of these.
    """

    part: ClassVar[type[Any]]
    """The class that they are of; see `Part`."""
    elsewhere: ClassVar[Mapping[str, str]] = {}
    """Keys that they lack and another command has: key to command."""

    def __init_subclass__(cls) -> None:
        torch.serialization.add_safe_globals([cls])

    def __post_init__(self) -> None:
        checks = Checks()
        for each in fields(self):
            value = getattr(self, each.name)
            if value is None and "None" in str(each.type):
                continue
            if isinstance(value, list):
                value = tuple(value)
                object.__setattr__(self, each.name, value)
            with checks.one():
                check_field(each, value)
        checks.end()
        self.check()

    def check(self) -> None:
        """What one field alone does not show; raises ConfigError or ValueRangeError."""

    def changed(self, **changes: Any) -> Self:
        """A copy with changes; raises ConfigError where a name is unknown."""
        check_names(type(self).__name__.removesuffix("Settings"), changes, names(type(self)))
        return dataclasses.replace(self, **changes)


Kind = TypeVar("Kind", bound=Settings)


def about_of(each: dataclasses.Field[Any]) -> About:
    """What a field's metadata tells; nothing where it has none."""
    return each.metadata.get("about") or About()


def names(kind: type[Any]) -> tuple[str, ...]:
    """The fields of a dataclass."""
    return tuple(each.name for each in fields(kind))


def keys(kind: type[Any]) -> tuple[dataclasses.Field[Any], ...]:
    """The fields that files and command lines may set."""
    return tuple(each for each in fields(kind) if about_of(each).key)


def default_of(each: dataclasses.Field[Any]) -> Any:
    """A field's default; MISSING where it has none."""
    return each.default if each.default_factory is MISSING else each.default_factory()


def check_field(each: dataclasses.Field[Any], value: Any) -> None:
    """Raises ConfigError or ValueRangeError where a field cannot hold the value."""
    check_type(each.name, value, each.type if isinstance(each.type, str) else named(each.type))
    about_of(each).check(each.name, value)


def differs(each: dataclasses.Field[Any], value: Any) -> bool:
    """Whether a field's value is another than its default."""
    default = default_of(each)
    return isinstance(value, Tensor) or (value is not default and bool(value != default))


def told(settings: Settings, everything: bool = False) -> list[str]:
    """Settings as "name=value": those that differ from their defaults, or everything."""
    words = []
    for each in fields(settings):
        value = getattr(settings, each.name)
        if everything or differs(each, value):
            shown = f"tensor{tuple(value.shape)}" if isinstance(value, Tensor) else repr(value)
            words.append(f"{each.name}={shown}")
    return words


def resolved(kind: type[Kind], given: Sequence[Any], changes: Mapping[str, Any]) -> Kind:
    """Settings as a constructor takes them: settings of that kind, or its values in order, and changes by name.

    Settings of a class derived from `kind` serve as well; what they have beyond it is left out.

    Raises:
        ConfigError: There are too many values, or a name is unknown.

    Example:
        >>> resolved(TaskIntegralSettings, (), {"gain": 2.0})
        TaskIntegralSettings(gain=2.0, reach=0.001)
    """
    told_names, owner = names(kind), kind.__name__.removesuffix("Settings")
    check_names(owner, changes, told_names)
    if len(given) == 1 and isinstance(given[0], kind):
        return kind(**{name: getattr(given[0], name) for name in told_names} | dict(changes))
    if len(given) == 1 and isinstance(given[0], Settings):
        raise ConfigError(f"{owner} takes {kind.__name__}, got {type(given[0]).__name__}")
    if len(given) > len(told_names):
        raise ConfigError(f"{owner} takes at most {len(told_names)} settings, got {len(given)}")
    by_position = dict(zip(told_names, given, strict=False))
    twice = by_position.keys() & changes.keys()
    if twice:
        raise ConfigError(f"{owner}: {', '.join(sorted(twice))} is given twice")
    missing = [e.name for e in fields(kind) if default_of(e) is MISSING and e.name not in {*by_position, *changes}]
    if missing:
        raise ConfigError(f"{owner}: {', '.join(missing)} must be given")
    return kind(**by_position, **changes)


def check_names(owner: str, given: Iterable[str], known: Sequence[str]) -> None:
    """Raises ConfigError where a name is unknown, with the one that it may stand for."""
    for name in given:
        if name not in known:
            raise ConfigError(f"{owner} has no setting {name!r}{did_you_mean(name, known)}")


def close(name: str, known: Iterable[str]) -> str | None:
    """The name that a mistyped one may stand for; None where nothing is close."""
    known = list(known)
    in_capitals = [each for each in known if each.casefold() == name.casefold()]
    return next(iter(in_capitals or difflib.get_close_matches(name, known, n=1, cutoff=0.6)), None)


def did_you_mean(name: str, known: Iterable[str]) -> str:
    """ "; did you mean gamma?", or what there is where nothing is close."""
    known = list(known)
    meant = close(name, known)
    if meant is not None:
        return f"; did you mean {meant}?"
    return f"; it has {', '.join(known)}" if known else "; it has none"


def check_choice(key: str, value: Any, options: Sequence[str]) -> str:
    """`value` if it is one of `options`.

    Raises:
        ConfigError: "mode must be one of position, pose, got 'both'".
    """
    if not isinstance(value, str) or value not in options:
        raise ConfigError(f"{key} must be one of {', '.join(options)}, got {shown(value)}")
    return value


def check_setting(name: str, value: Value, zero: bool = False) -> Value:
    """Returns `value` if it, or every number in it, is finite and positive, or with `zero` zero; reads values.

    Raises:
        ValueRangeError: "damping must be positive and finite, got -1.0".
    """
    (About(least=0.0) if zero else About(above=0.0)).check(name, value)
    return value


def aligned(value: Value, extra: int) -> Value:
    """The setting for use on tensors with `extra` dimensions behind the batch's: (...) becomes (..., 1, ...)."""
    return value[(..., *(None,) * extra)] if isinstance(value, Tensor) else value  # type: ignore[return-value]


def is_on(value: Setting) -> bool:
    """Whether a setting that zero turns off is on: a number above zero. Rows with a tensor of them are all on."""
    return isinstance(value, Tensor) or value > 0
