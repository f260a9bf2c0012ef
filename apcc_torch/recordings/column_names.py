"""What the columns of a table hold, told by their names or by a declaration."""

from __future__ import annotations

import fnmatch
import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace

from apcc_torch.errors import ConfigError, DataError
from apcc_torch.recordings.csv_table import Sheet
from apcc_torch.recordings.declaration import FRAMES, METRES, SECONDS, RecordingSettings, columns_of
from apcc_torch.recordings.name_styles import (
    COUNTS,
    DRIVES,
    NANOSECONDS,
    NO_BODY,
    ONE,
    STYLES,
    TARGET,
    TIMES,
    UNIT,
)
from apcc_torch.settings import did_you_mean


@dataclass(frozen=True)
class BodyColumns:
    """The columns of a body.

    turn: Four of a quaternion as they stand in the file, with `order`, which of x, y, z and w each is; nine of a
    matrix, column by column; three of angles; or none. tracked: Whether it was seen.
    """

    name: str
    position: tuple[str, ...]
    turn: tuple[str, ...] = ()
    order: str = "xyzw"
    tracked: str | None = None


@dataclass(frozen=True)
class Columns:
    """The columns of a recording.

    time: Each with what its unit is in s, to be summed up; none where frames come at a rate. unit: Of positions, m.
    rate: Frames a second, where the file says it. zero_untracked: Whether a body at 0, 0, 0 was not seen.
    euler_order: Of its angles, where the file says it.
    """

    bodies: tuple[BodyColumns, ...]
    time: tuple[tuple[str, float], ...] = ()
    inputs: tuple[str, ...] = ()
    actuators: tuple[str, ...] = ()
    target: tuple[str, ...] = ()
    unit: float = 1.0
    rate: float | None = None
    zero_untracked: bool = False
    euler_order: str | None = None

    def all(self) -> list[str]:
        """Every column that is read."""
        of_bodies = [c for b in self.bodies for c in (*b.position, *b.turn, *([b.tracked] if b.tracked else []))]
        return [*of_bodies, *(name for name, _ in self.time), *self.inputs, *self.actuators, *self.target]


def columns_in(sheet: Sheet, settings: RecordingSettings, wanted: int | None = None) -> Columns:
    """What a table's columns hold.

    Args:
        sheet: The table.
        settings: What is declared.
        wanted: How many inputs the arm has. Where no name tells inputs, and so many columns are left, those are.

    Raises:
        ConfigError: A declaration names no column.
        DataError: A column is missing; the sentence names it.
    """
    names, unit = sheet.names, 1.0
    if settings.listed:
        bodies = [BodyColumns(f"body{i + 1}", tuple(columns)) for i, columns in enumerate(settings.listed)]
    elif settings.position:
        if "{body}" in settings.position and not settings.named:
            raise ConfigError("recording.bodies must name the bodies that {body} in recording.position stands for")
        bodies = [
            BodyColumns(name, columns_of("position", settings.position, name, "xyz"))
            for name in settings.named or (ONE,)
        ]
    else:
        bodies, unit = _recognised(sheet)
        bodies = chosen(bodies, settings, str(sheet.path))
    bodies = [_turned(each, settings, names) for each in bodies]
    inputs, actuators = drives(names, settings)
    target = TARGET if any(name in names for name in TARGET) else ()
    found = Columns(tuple(bodies), clock(names, settings), inputs, actuators, target, unit)
    if not inputs and not actuators:
        taken = {*found.all(), settings.group}
        left = tuple(name for name in names if name not in taken and name.lower() not in (*COUNTS, "id"))
        found = replace(found, inputs=left if len(left) == wanted else ())
    sheet.require(found.all())
    return found


def chosen(bodies: Sequence[BodyColumns], settings: RecordingSettings, source: str) -> list[BodyColumns]:
    """The bodies that the declaration names, in its order; all where it names none.

    Raises:
        DataError: One of them is not there.
    """
    if not settings.named:
        return list(bodies)
    there = {each.name: each for each in bodies}
    for name in settings.named:
        if name not in there:
            raise DataError(f"{source}: has no body {name!r}{did_you_mean(name, there)}")
    return [there[name] for name in settings.named]


def _recognised(sheet: Sheet) -> tuple[list[BodyColumns], float]:
    """The bodies that a table's names tell, in the order of their first columns, and the unit, m."""
    bare = {name: UNIT.sub("", name) for name in sheet.names}
    units = {name: found[1].lower() for name in sheet.names if (found := _unit(name))}
    for style in STYLES:
        for told in (bare, {name: name for name in sheet.names}):
            places = _matches(told, style.position, "xyz")
            places = {body: axes for body, axes in places.items() if not NO_BODY.search(body)}
            if not places:
                continue
            turns = _matches(told, style.quaternion, "xyzw0123")
            bodies = [
                BodyColumns(body or ONE, _complete(sheet, axes, "xyz"), *_ordered(sheet, turns.get(body, {})))
                for body, axes in places.items()
            ]
            if all(each.name.isdecimal() for each in bodies):
                bodies.sort(key=lambda each: int(each.name))
            told_unit = units.get(bodies[0].position[0], "") if told is bare else ""
            return bodies, METRES.get(told_unit, 1.0)
    raise DataError(
        f"{sheet.path}, column '<body>_x': the column is missing (no body has a position that its columns' names tell; "
        "recording.bodies or recording.position name them)"
    )


def _unit(name: str) -> tuple[str, str] | None:
    """A name without its unit, and that."""
    found = UNIT.search(name)
    return None if found is None else (name[: found.start()], found["a"] or found["b"])


def _matches(told: dict[str, str], pattern: str, axes: str) -> dict[str, dict[str, str]]:
    """Body -> axis -> column, of the names that a pattern fits."""
    found: dict[str, dict[str, str]] = {}
    for name, bare in told.items():
        match = re.fullmatch(pattern, bare, re.IGNORECASE)
        if match is not None and match["axis"].lower() in axes:
            found.setdefault(match["body"] or "", {})[match["axis"].lower()] = name
    return found


def _complete(sheet: Sheet, there: dict[str, str], axes: str) -> tuple[str, ...]:
    """The columns of all axes.

    Raises:
        DataError: One is missing.
    """
    for axis in axes:
        if axis not in there:
            other, name = next(iter(there.items()))
            at = max(name.lower().rfind(other), 0)
            raise DataError(f"{sheet.path}, column {name[:at] + axis + name[at + 1 :]!r}: the column is missing")
    return tuple(there[axis] for axis in axes)


def _ordered(sheet: Sheet, there: dict[str, str]) -> tuple[tuple[str, ...], str]:
    """A quaternion's columns as they stand in the file, and which each is; none where there is none."""
    if not there:
        return (), "xyzw"
    numbered = any(axis.isdecimal() for axis in there)
    _complete(sheet, there, "0123" if numbered else "xyzw")
    stand = sorted(there, key=lambda axis: sheet.names.index(there[axis]))
    return tuple(there[axis] for axis in stand), "?" if numbered else "".join(stand)


def _turned(body: BodyColumns, settings: RecordingSettings, names: Sequence[str]) -> BodyColumns:
    """A body with its orientation's columns as declared, and with the column that says whether it was seen."""
    turn, order = body.turn, body.order
    if settings.euler:
        turn = columns_of("euler", settings.euler, body.name, "xyz")
        turn = turn if turn[0] in names else columns_of("euler", settings.euler, body.name, ("1", "2", "3"))
    elif settings.quaternion:
        for axes in ("xyzw", "0123", "1234"):
            turn = columns_of("quaternion", settings.quaternion, body.name, axes)
            if turn[1] in names:
                break
        else:
            axes = "xyzw"
            turn = columns_of("quaternion", settings.quaternion, body.name, axes)
        stand = sorted(range(4), key=lambda k: names.index(turn[k]) if turn[k] in names else k)
        turn, order = tuple(turn[k] for k in stand), "".join(axes[k] for k in stand)
    if len(turn) == 4:
        if settings.quaternion_order is None and not order.isalpha():
            raise ConfigError(
                f"recording.quaternion_order must be given, xyzw or wxyz: numbers are all that {turn[0]!r} says"
            )
        order = settings.quaternion_order or order
    tracked = f"{body.name}_tracked"
    return BodyColumns(body.name, body.position, turn, order, tracked if tracked in names else body.tracked)


def drives(names: Sequence[str], settings: RecordingSettings) -> tuple[tuple[str, ...], tuple[str, ...]]:
    """The columns of what was sent to the actuators, and of what they measured.

    Raises:
        ConfigError: A declared one is not there.
    """
    if settings.inputs:
        return matching("inputs", settings.inputs, names), ()
    sent = next((found for stem in DRIVES if (found := _numbered(names, stem))), ())
    return sent, _numbered(names, "phi")


def matching(key: str, patterns: Iterable[str], names: Sequence[str]) -> tuple[str, ...]:
    """The names that patterns mean, in the order of the patterns and of the numbers in the names."""
    found: list[str] = []
    for pattern in patterns:
        if "*" not in pattern:
            found.append(pattern)
            continue
        fit = sorted(fnmatch.filter(names, pattern), key=_natural)
        if not fit:
            raise ConfigError(f"recording.{key}: nothing is called {pattern}; there are {', '.join(names)}")
        found += fit
    return tuple(dict.fromkeys(found))


def _natural(name: str) -> list[tuple[int, str]]:
    return [(int(part), "") if part.isdecimal() else (-1, part) for part in re.split(r"(\d+)", name)]


def _numbered(names: Sequence[str], stem: str) -> tuple[str, ...]:
    """The columns stem1, stem2, ..., with or without _, up to the highest number there is; they may begin at 0."""
    pattern = re.compile(rf"({stem}_?)(\d{{1,4}})", re.IGNORECASE)
    fits = {name: match for name in names if (match := pattern.fullmatch(UNIT.sub("", name)))}
    if not fits:
        return ()
    numbered = {int(match[2]): name for name, match in fits.items()}
    spelled = fits[next(iter(numbered.values()))][1]
    return tuple(numbered.get(k, f"{spelled}{k}") for k in range(min(min(numbered), 1), max(numbered) + 1))


def clock(names: Sequence[str], settings: RecordingSettings) -> tuple[tuple[str, float], ...]:
    """The columns of the time, and what each counts, s; none where frames come at the rate."""
    if settings.time is not None:
        return ((settings.time, _seconds(settings.time, settings)),)
    for name in names:
        found = re.fullmatch(r"(.*stamp[._/])secs?", name, re.IGNORECASE)
        if found is not None:
            rest = re.escape(found[1]) + r"n(?:ano)?secs?"
            return (name, 1.0), *((other, 1e-9) for other in names if re.fullmatch(rest, other, re.IGNORECASE))
    for name in names:
        if UNIT.sub("", name).strip().lower() in TIMES:
            return ((name, _seconds(name, settings)),)
    for name in names:
        if name.lower() in NANOSECONDS:
            return ((name, SECONDS["ns"] if settings.time_unit is None else _seconds(name, settings)),)
    if settings.time_unit is not None:
        for name in names:
            if name.lower() in COUNTS:
                return ((name, _seconds(name, settings)),)
    return ()


def _seconds(name: str, settings: RecordingSettings) -> float:
    """What a column of times counts, s."""
    if settings.time_unit is None:
        found = _unit(name)
        told = "" if found is None else found[1].lower()
        return SECONDS.get({"seconds": "s", "milliseconds": "ms"}.get(told, told), 1.0)
    return 1.0 / settings.rate if settings.time_unit == FRAMES else SECONDS[settings.time_unit]
