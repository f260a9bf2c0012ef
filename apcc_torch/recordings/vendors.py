"""Exports of motion-capture programs: their headers of several lines, as the columns of a table."""

from __future__ import annotations

import re
from collections.abc import Iterator
from itertools import islice
from pathlib import Path

from apcc_torch.errors import DataError
from apcc_torch.recordings.column_names import BodyColumns, Columns, chosen, drives
from apcc_torch.recordings.csv_table import LONGEST_NAME, Sheet, cells_of
from apcc_torch.recordings.declaration import METRES, RecordingSettings

MOTIVE, QUALISYS = "Format Version", ("NO_OF_FRAMES", "FILE_VERSION")
"""What the files begin with."""
LONGEST_HEADER = 40
"""Most lines of a header."""
UNITS = {"meters": "m", "centimeters": "cm", "millimeters": "mm"}
TURNS = {"quaternion": "XYZW"}
"""Motive's word for a kind of rotation -> its columns; a word such as XYZ names three angles."""
POSE, MATRIX = ("X", "Y", "Z"), tuple(f"Rot[{i}]" for i in range(9))


def vendor_of(text: str) -> str | None:
    """ "motive" or "qualisys", by what a file begins with; None for any other."""
    if text.startswith((MOTIVE, f'"{MOTIVE}"')):
        return "motive"
    return "qualisys" if text.startswith(QUALISYS) else None


def _lines(text: str) -> Iterator[tuple[str, int]]:
    """The first lines, and where each ends."""
    at = 0
    for _ in range(LONGEST_HEADER):
        end = text.find("\n", at) + 1 or len(text)
        if at >= len(text):
            return
        yield text[at:end].rstrip("\r\n"), end
        at = end


def motive(path: Path, text: str, settings: RecordingSettings) -> tuple[Sheet, Columns]:
    """OptiTrack Motive's CSV export: rows of facts, types, names, properties and axes above the data.

    Rigid bodies are the bodies; without any, single markers are.

    Raises:
        DataError: It is not in that layout, or lacks a body.
    """
    rows: list[list[str]] = []
    begin = 0
    for line, begin in _lines(text):  # noqa: B007  where the data begins
        rows.append(cells_of(path, line, ","))
        if rows[-1][:1] == ["Frame"]:
            break
    else:
        raise DataError(f"{path}: is not Motive's export, no line begins with Frame")
    facts = dict(zip(rows[0][::2], rows[0][1::2], strict=False))
    axes = rows[-1]
    told = {next(filter(None, row[:3]), "").lower(): row for row in rows[1:-1]}
    kinds = next((row for row in rows[1:-1] if "Position" in row), None)
    if kinds is None or "name" not in told or "type" not in told:
        raise DataError(f"{path}: is not Motive's export, it has no lines of types, names and properties")
    width = len(axes)
    kind, name, what = ([*row, *[""] * width][:width] for row in (told["type"], told["name"], kinds))
    columns = [f"{n} {w} {a}".strip() if n else a for n, w, a in zip(name, what, axes, strict=True)]
    if any(len(c) > 2 * LONGEST_NAME for c in columns):
        raise DataError(f"{path}: a name in its header has over {LONGEST_NAME} characters")
    # Columns of no use, such as errors of markers, may share a name.
    first = {c: i for i, c in reversed(list(enumerate(columns)))}
    columns = [c if first[c] == i else f"{c} ({i + 1})" for i, c in enumerate(columns)]
    form = facts.get("Rotation Type", "Quaternion").lower()
    axes_of_turn = TURNS.get(form, form.upper())
    placed = [i for i in range(width) if what[i] == "Position" and axes[i] == "X"]
    bodies = [i for i in placed if kind[i].lower() == "rigid body"] or [
        i for i in placed if "marker" in kind[i].lower()
    ]
    found = []
    for n in dict.fromkeys(name[i] for i in bodies):
        turn = tuple(f"{n} Rotation {axis}" for axis in axes_of_turn)
        found.append(
            BodyColumns(n, tuple(f"{n} Position {axis}" for axis in POSE), turn if turn[0] in columns else (), "xyzw")
        )
    time = next((c for c in columns if c.lower().startswith("time")), None)
    inputs, actuators = drives(columns, settings)
    rate = facts.get("Export Frame Rate") or facts.get("Capture Frame Rate") or ""
    result = Columns(
        tuple(chosen(found, settings, str(path))),
        () if time is None else ((time, 1.0),),
        inputs,
        actuators,
        unit=METRES[UNITS.get(facts.get("Length Units", "").lower(), "m")],
        rate=_positive(rate),
        euler_order=None if form == "quaternion" else form,
    )
    sheet = Sheet(path, tuple(columns), text[begin:], len(rows), ",", ".")
    return _checked(sheet, result)


def qualisys(path: Path, text: str, settings: RecordingSettings) -> tuple[Sheet, Columns]:
    """Qualisys' TSV export of markers (3D) or of bodies (6D): lines of a word and values, then the data, in mm.

    Raises:
        DataError: It is not in that layout, or lacks a body.
    """
    facts: dict[str, list[str]] = {}
    header: list[str] = []
    at = number = 0
    for line, end in _lines(text):
        cells = line.split("\t")
        if not re.fullmatch(r"[A-Z][A-Z0-9_]+", cells[0].strip()):
            if not re.fullmatch(r"[-+]?[\d.]+", cells[0].strip()):  # the names of the columns, where they were exported
                header, at, number = cells, end, number + 1
            break
        facts[cells[0].strip()] = [cell.strip() for cell in cells[1:]]
        at, number = end, number + 1
    names = facts.get("BODY_NAMES") or facts.get("MARKER_NAMES") or []
    names = [name for name in names if name]
    six = bool(facts.get("BODY_NAMES"))
    first = next(iter(_lines(text[at:])), ("", 0))[0].rstrip("\t").split("\t")
    wide = [*POSE, "Roll", "Pitch", "Yaw", "Residual", *MATRIX] if six else list(POSE)
    before = len(first) - len(wide) * len(names)
    if not names or not 0 <= before <= 2:
        raise DataError(
            f"{path}, line {number + 1}: is not Qualisys' export, {len(names)} bodies or markers do not fill the "
            f"{len(first)} cells of a line"
        )
    lead = (
        ["Frame", "Time"][:before]
        if not header or header[0].lower().startswith("frame")
        else ["Time", "Frame"][:before]
    )
    columns = [*lead, *(f"{name} {part}" for name in names for part in wide)]
    bodies = [
        BodyColumns(n, tuple(f"{n} {p}" for p in POSE), tuple(f"{n} {p}" for p in MATRIX) if six else ()) for n in names
    ]
    rate = _positive(next(islice(facts.get("FREQUENCY", []), 1), ""))
    result = Columns(
        tuple(chosen(bodies, settings, str(path))),
        (("Time", 1.0),) if "Time" in lead else (),
        unit=METRES["mm"],
        rate=rate,
        zero_untracked=True,
    )
    return _checked(Sheet(path, tuple(columns), text[at:], number, "\t", None), result)


def _checked(sheet: Sheet, columns: Columns) -> tuple[Sheet, Columns]:
    if not columns.bodies:
        raise DataError(f"{sheet.path}: holds neither bodies nor markers")
    sheet.require(columns.all())
    return sheet, columns


def _positive(text: str) -> float | None:
    """A positive number; None where there is none."""
    try:
        value = float(text.replace(",", "."))
    except ValueError:
        return None
    return value if value > 0 else None
