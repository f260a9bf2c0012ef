"""The tidy table of a set of runs: one row a run, a column for what it is, each swept key, and each metric."""

from __future__ import annotations

import csv
import io
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from apcc_torch.files import draft_of, write_atomically
from apcc_torch.plain_text import for_spreadsheet, for_terminal
from apcc_torch.report.run_record import Run
from apcc_torch.report.settings import comparable, swept_keys, text_of
from apcc_torch.report.units import Label, key_label, metric_label

try:
    import pyarrow
    from pyarrow import parquet
except ImportError:  # an extra; CSV needs nothing
    pyarrow = parquet = None

KEY, METRIC, ABOUT = "key", "metric", "about"
"""Kinds of columns: a swept key, a metric, or a word about the run."""
WALL = "wall_s"

Cell = int | float | str | None


@dataclass(frozen=True)
class Column:
    """One column: numbers, or texts, or None where a run has no value.

    name: Its name in files.
    kind: key, metric or about.
    label: How it is headed.
    cells: One a run.
    number: Whether the cells are numbers.
    """

    name: str
    kind: str
    label: Label
    cells: list[Cell]
    number: bool

    @property
    def varies(self) -> bool:
        """Whether two runs differ in it."""
        return len(set(self.cells)) > 1


@dataclass(frozen=True)
class RunTable:
    """Runs as columns of one length."""

    columns: list[Column]

    def __len__(self) -> int:
        """Number of runs."""
        return len(self.columns[0].cells)

    def of_kind(self, kind: str) -> list[Column]:
        """The columns of a kind, in order."""
        return [column for column in self.columns if column.kind == kind]

    def column(self, name: str) -> Column:
        """The column of a name, which must be there."""
        return next(column for column in self.columns if column.name == name)


def tidy(runs: Sequence[Run]) -> RunTable:
    """The table of the runs: run, status, swept keys, metrics, wall time, note."""
    own = list(dict.fromkeys(key for run in runs for key in run.own))
    keys = swept_keys([run.settings for run in runs], [run.overrides for run in runs], own)
    metrics = dict.fromkeys(name for run in runs for name in run.metrics if name != WALL)
    columns = [
        _words("run", [run.name for run in runs]),
        _words("status", [run.status for run in runs]),
        *(_key(key, [_setting(run, key) for run in runs]) for key in keys),
        *(_metric(name, runs) for name in metrics),
        _metric(WALL, runs),
        _words("note", [run.note for run in runs]),
    ]
    return RunTable(_told_apart(columns))


def _told_apart(columns: Sequence[Column]) -> list[Column]:
    """The columns, each of a name of its own: what a file calls a value may be the name of another column."""
    taken = {column.name for column in columns if column.kind == ABOUT}
    result = []
    for column in columns:
        name = column.name
        if column.kind != ABOUT:
            while name in taken:
                name += f" ({column.kind})"
            taken.add(name)
        result.append(replace(column, name=name))
    return result


def line(text: str) -> str:
    """Text of a file as one line, which shows and does nothing else."""
    return for_terminal(text).replace("\n", r"\n").replace("\t", r"\t")


def _words(name: str, cells: Sequence[str]) -> Column:
    return Column(name, ABOUT, Label(name, ""), [line(cell) for cell in cells], False)


def _setting(run: Run, key: str) -> object:
    return run.settings[key] if key in run.settings else run.overrides.get(key)


def _key(key: str, values: list[object]) -> Column:
    """A column of numbers where every value is one, else of texts."""
    given = [value for value in values if value is not None]
    number = bool(given) and all(_is_number(value) for value in given)
    cells: list[Cell]
    if not number:
        cells = [None if value is None else line(text_of(value)) for value in values]
    elif all(isinstance(value, int) for value in given):
        cells = [None if value is None else int(value) for value in values]  # type: ignore[call-overload]
    else:
        cells = [None if value is None else float(value) for value in values]  # type: ignore[arg-type]
    return Column(line(key), KEY, key_label(line(key)), cells, number)


def _is_number(value: object) -> bool:
    """Whether the value is a number that every table can hold."""
    if isinstance(value, bool) or not isinstance(value, int | float):
        return False
    return isinstance(value, float) or abs(value) < 2**63


def _metric(name: str, runs: Sequence[Run]) -> Column:
    return Column(line(name), METRIC, metric_label(line(name)), [run.metrics.get(name) for run in runs], True)


def differing(table: RunTable) -> list[Column]:
    """The swept keys in which runs differ, 1 and 1.0 being one value."""
    return [column for column in table.of_kind(KEY) if len({comparable(cell) for cell in column.cells}) > 1]


def write_csv(table: RunTable, path: Path) -> Path:
    """Writes the table as CSV; a number's text reads back as the same number, no value is an empty cell.

    Texts that a spreadsheet would carry out have an apostrophe before them.
    """
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(for_spreadsheet(column.name) for column in table.columns)
    cells = zip(*(_exported(column) for column in table.columns), strict=True)
    writer.writerows(["" if cell is None else cell for cell in row] for row in cells)
    return write_atomically(path, text.getvalue())


def _exported(column: Column) -> list[Cell]:
    return [for_spreadsheet(cell) if isinstance(cell, str) else cell for cell in column.cells]


def has_parquet() -> bool:
    """Whether pyarrow is there, which Parquet needs."""
    return pyarrow is not None


def write_parquet(table: RunTable, path: Path) -> Path:
    """Writes the table as Parquet: numbers as int64 or float64, texts as strings. `has_parquet` says whether it can."""
    data = pyarrow.table({for_spreadsheet(column.name): _arrow(column) for column in table.columns})
    # An open file: of a path pyarrow makes an address, which not every name is.
    with draft_of(path) as draft, draft.open("wb") as file:
        parquet.write_table(data, file)
    return path


def _arrow(column: Column) -> object:
    whole = column.number and column.kind == KEY and all(isinstance(cell, int | None) for cell in column.cells)
    kind = pyarrow.int64() if whole else pyarrow.float64() if column.number else pyarrow.string()
    return pyarrow.array(_exported(column), kind)
