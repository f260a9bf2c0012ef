"""Recordings read from files, as labs and their programs write them.

A table is a text file with a line of names above its numbers; columns may come in any order, and those that nothing
asks for are ignored. Without a declaration the names tell what a column holds, as in `save_recording`'s files:

    time                                          s, not decreasing; t, timestamp, time_ms, header.stamp.sec, ... too
    <body>_x, <body>_y, <body>_z                  position; x1, y1, z1, ... and <body>.pose.position.x, ... too
    <body>_qx, <body>_qy, <body>_qz, <body>_qw    unit quaternion that rotates the body's axes into the recording frame;
                                                  a body may lack all four, and has no orientation then
    <body>_tracked      optional                  1 or 0; without it a body is tracked where its position is not empty
    u1, u2, ...         optional                  inputs sent to the actuators, in the actuators' own unit
    phi1, phi2, ...     optional                  what the actuators measured, in their own unit
    target_x, target_y, target_z   optional       target of the tip in the recording frame, m

Bodies are numbered from the base to the tip in the order in which their first columns appear, or by their numbers.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from apcc_torch.errors import DataError
from apcc_torch.model.arm import Arm
from apcc_torch.recordings.bag import bag_frames, is_bag
from apcc_torch.recordings.column_names import Columns, columns_in
from apcc_torch.recordings.csv_table import CsvTable, Sheet, sheet_of, text_of
from apcc_torch.recordings.declaration import RecordingSettings
from apcc_torch.recordings.frames_read import FramesRead
from apcc_torch.recordings.plausibility import check_guess
from apcc_torch.recordings.raw_poses import placed, raw_poses
from apcc_torch.recordings.recording import Recording
from apcc_torch.recordings.vendors import motive, qualisys, vendor_of
from apcc_torch.settings import resolved

OWN = "recording.csv"
"""Name of a recording in a folder that is given for it."""
TABLES = (".csv", ".tsv", ".txt", ".dat")
"""What the names of tables end with."""
OBSERVATIONS, CONTROL = "observations_", "control_inputs_"
"""What the trunk-stack's files are called before their own names: poses, and the inputs beside them."""
LONG_STEP = 2.0
"""Steps of a time that are as long, in whose unit nobody named it, are hardly seconds."""


def detect_layout(path: str | Path) -> str:
    """How a file is laid out, by its name, and that of a folder by what it holds: "trunk", "bag" or "table".

    Example:
        >>> detect_layout("run/observations_1.csv"), detect_layout("run/arm.csv"), detect_layout("run/log.mcap")
        ('trunk', 'table', 'bag')
    """
    path = Path(path)
    names = [path.name, *(result.name for result in path.glob(f"{OBSERVATIONS}*.csv"))]
    if any(name.startswith(OBSERVATIONS) for name in names):
        return "trunk"
    return "bag" if is_bag(path) else "table"


def load_recording(path: str | Path, *given: Any, arm: Arm | None = None, **changes: Any) -> Recording:
    """Reads a recording whole, in float64.

    Args:
        path: The file, or the folder that holds it.
        *given: See `RecordingSettings`.
        arm: What is recorded: what the file does not say is guessed, and the guess held against the arm's lengths.
        **changes: See `RecordingSettings`.

    Raises:
        ConfigError: A setting has no meaning.
        DataError: A file is missing, or damaged, or not what it is taken for; the sentence names the file, the column
            and the line, or says what to declare.

    Example:
        >>> with TemporaryDirectory() as folder:
        ...     _ = Path(folder, "arm.csv").write_text("t,x_tip,y_tip,z_tip\\n0.0,0,0,-450\\n0.1,9,0,-449\\n")
        ...     recording = load_recording(Path(folder, "arm.csv"), unit="mm")
        >>> recording.names, recording.position[-1].tolist()
        (('tip',), [[0.009000000000000001, 0.0, -0.449]])
    """
    settings = resolved(RecordingSettings, given, changes)
    path = Path(path)
    layout = detect_layout(path) if settings.layout == "auto" else settings.layout
    frames = READERS[layout](path, settings, None if arm is None else max(arm.actuation.driving(arm.n_tendons)) + 1)
    posed = frames.raw.posed(settings)
    if arm is not None:
        check_guess(frames.raw, posed, settings, arm, frames.source)
    return Recording(
        frames.names,
        frames.times,
        posed.position,
        posed.quaternion,
        frames.raw.tracked,
        frames.inputs,
        frames.actuators,
        None if frames.target is None else placed(frames.target, settings, frames.raw.unit),
        frames.groups,
        frames.source,
    )


def _table(path: Path, settings: RecordingSettings, inputs: int | None) -> FramesRead:
    path = _file(path)
    text = text_of(path)
    vendor = {"auto": vendor_of(text), "table": None}.get(settings.layout, settings.layout)
    if vendor is not None:
        return _frames(*{"motive": motive, "qualisys": qualisys}[vendor](path, text, settings), settings)
    sheet = sheet_of(path, text, settings.delimiter, settings.decimal, settings.comment)
    return _frames(sheet, columns_in(sheet, settings, inputs), settings)


def _file(path: Path) -> Path:
    """The file of a folder: recording.csv, or the only table in it."""
    if not path.is_dir() or (path / OWN).is_file():
        return path / OWN if path.is_dir() else path
    tables = sorted(each for each in path.iterdir() if each.suffix in TABLES)
    if len(tables) > 1:
        raise DataError(f"{path}: holds {len(tables)} tables; name one of them, or call one {OWN}")
    return tables[0] if tables else path / OWN


def _frames(sheet: Sheet, columns: Columns, settings: RecordingSettings) -> FramesRead:
    words = [] if settings.group is None else [settings.group]
    table = sheet.table(columns.all(), words)
    times = _times(table, columns, settings)
    return FramesRead(
        tuple(body.name for body in columns.bodies),
        times,
        raw_poses(table, columns, settings),
        _finite(table, columns.inputs),
        _finite(table, columns.actuators),
        _finite(table, columns.target),
        None if settings.group is None else _groups(table.words[settings.group], settings.group_ending),
        str(sheet.path),
    )


def _finite(table: CsvTable, names: tuple[str, ...]) -> Tensor | None:
    return table.finite(names) if names else None


def _groups(words: list[str], ending: str) -> Tensor:
    """(T,) int64, the same number for the same word."""
    bare = [word.removesuffix(ending) for word in words]
    numbers = {word: i for i, word in enumerate(dict.fromkeys(bare))}
    return torch.tensor([numbers[word] for word in bare])


def _times(table: CsvTable, columns: Columns, settings: RecordingSettings) -> Tensor:
    """(T,) s.

    Raises:
        DataError: They go backward, or are hardly what they are taken for.
    """
    if not columns.time:
        rate = settings.rate if columns.rate is None else columns.rate
        return torch.arange(len(table.cells), dtype=torch.float64) / rate
    names = [name for name, _ in columns.time]
    values = table.finite(names)
    times = (values * values.new_tensor([unit for _, unit in columns.time])).sum(-1)
    steps = times.diff()
    backward = (steps < 0).nonzero()
    if len(backward):
        raise table.fault("the time goes backward", names[0], int(backward[0]) + 1)
    # Nobody named the unit, so it is guessed; recordings of long pauses may say time_unit: s.
    if columns.time == ((names[0], 1.0),) and settings.time_unit is None and len(steps):
        step = float(steps.median())
        if step >= LONG_STEP:
            unit = "ms" if step < 2e3 else "us" if step < 2e6 else "ns"
            raise table.fault(
                f"steps are {step:g} long, hardly seconds: write recording.time_unit: {unit}, frames, or s", names[0]
            )
    return times


def _trunk(path: Path, settings: RecordingSettings, _: int | None) -> FramesRead:
    """The trunk-stack's observations_NAME.csv and, beside it, control_inputs_NAME.csv.

    Observations may outnumber the inputs by one, the one after the last input, which is left out.
    """
    result = sorted(path.glob(f"{OBSERVATIONS}*.csv")) if path.is_dir() else [path]
    if len(result) != 1:
        raise DataError(f"{path}: holds {len(result)} files {OBSERVATIONS}*.csv where one is wanted")
    sheet = sheet_of(result[0], text_of(result[0]), settings.delimiter, settings.decimal, settings.comment)
    columns = columns_in(sheet, settings)
    if not settings.bodies:
        disks = tuple(replace(body, name=f"disk{body.name}") for body in columns.bodies)
        columns = replace(columns, bodies=disks)
    sheet.require(["ID"])
    frames, rows = _frames(sheet, columns, settings), _numbered_rows(sheet)
    sent = result[0].with_name(result[0].name.replace(OBSERVATIONS, CONTROL, 1))
    if sent == result[0] or not sent.is_file() or settings.inputs:
        return frames
    commands = sheet_of(sent, text_of(sent), settings.delimiter, settings.decimal, settings.comment)
    names = [name for name in commands.names if name != "ID"]
    inputs = commands.table(names).finite(names)
    T = len(inputs)
    if rows not in (T, T + 1):
        raise DataError(f"{sent}: holds {T} data lines where {result[0].name} holds {rows}")
    return replace(frames.first(T), inputs=inputs)


def _numbered_rows(sheet: Sheet) -> int:
    """How many lines there are, each of which has its number.

    Raises:
        DataError: One is missing.
    """
    table = sheet.table(["ID"])
    ids = table.finite(["ID"])[:, 0]
    gap = (ids != torch.arange(len(ids), dtype=ids.dtype)).nonzero()
    if len(gap):
        raise table.fault("the number must be that of the data line, counted from 0", "ID", int(gap[0]))
    return len(ids)


READERS: dict[str, Callable[[Path, RecordingSettings, int | None], FramesRead]] = {
    "table": _table,
    "trunk": _trunk,
    "motive": _table,
    "qualisys": _table,
    "bag": bag_frames,
}
"""Layout -> what reads it; the arm's number of inputs, where it is known, tells columns that nothing else tells."""
