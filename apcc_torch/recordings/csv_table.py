"""Tables of numbers in text files, read whole, with errors that name the place."""

from __future__ import annotations

import csv
import io
import math
import re
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import torch
from torch import Tensor

from apcc_torch.errors import DataError
from apcc_torch.files import read_text
from apcc_torch.settings import close

MOST_TABLE = 2**30
"""Largest recording that is read, bytes."""
DELIMITERS = {"tab": "\t", "blank": " "}
"""Words for what is hard to see."""
EMPTY = ("", "nan", "null", "na", "n/a", "none", "-")
"""What stands in a cell without a number."""
COMMA = re.compile(r"[-+]?\d*,\d+([eE][-+]?\d+)?")
"""A number with a decimal comma."""
LONGEST_NAME = 500
"""Most characters of a column's name."""
LOOKED_AT = 200
"""Lines that are looked at for decimal commas."""
LARGEST = 1e15
"""Largest number that a recording may hold: squared it is one still. Stamps are in seconds."""


@dataclass(frozen=True)
class CsvTable:
    """The columns of a table that were asked for: numbers, where empty cells are NaN, and words."""

    path: Path
    columns: dict[str, int]
    lines: list[int]
    cells: Tensor  # (T, number of columns)
    words: dict[str, list[str]] = field(default_factory=dict)

    def fault(self, what: str, column: str | None = None, row: int | None = None) -> DataError:
        """The error to raise: one sentence that names the file, the column and the line of data row `row`."""
        place = str(self.path)
        if column is not None:
            place += f", column {column!r}"
        if row is not None:
            place += f", line {self.lines[row]}"
        return DataError(f"{place}: {what}")

    def take(self, names: Sequence[str]) -> Tensor:
        """The named columns, shape (T, n)."""
        for name in names:
            if name not in self.columns:
                raise self.fault("the column is missing", name)
        return self.cells[:, [self.columns[name] for name in names]]

    def finite(self, names: Sequence[str], wanted: Tensor | None = None) -> Tensor:
        """The named columns, where every cell that is `wanted` (T,) must hold a finite number."""
        values = self.take(names)
        right = values.abs() <= LARGEST
        bad = ~right if wanted is None else ~right & wanted.unsqueeze(-1)
        if bool(bad.any()):
            row, k = (int(i) for i in bad.nonzero()[0])
            raise self.fault(_fault(values[row, k]), names[k], row)
        return values

    def known(self, names: Sequence[str]) -> Tensor:
        """The named columns, of which cells may be empty, but none infinite or beyond what a recording may hold."""
        values = self.take(names)
        bad = values.abs() > LARGEST
        if bool(bad.any()):
            row, k = (int(i) for i in bad.nonzero()[0])
            raise self.fault(_fault(values[row, k]), names[k], row)
        return values


def _fault(value: Tensor) -> str:
    """What is wrong with the number in a cell."""
    return f"the cell holds {f'a number beyond {LARGEST:g}' if bool(value.isfinite()) else 'no finite number'}"


@dataclass(frozen=True)
class Sheet:
    """A table's text, of which the header is read.

    path: Its file. names: Of the columns. body: What follows the header. first: Lines before that.
    delimiter: "" for any number of blanks. decimal: Mark in numbers; None: as the cells show. comment: What begins a
    line that is passed over.
    """

    path: Path
    names: tuple[str, ...]
    body: str
    first: int
    delimiter: str = ","
    decimal: str | None = None
    comment: str = ""

    def require(self, names: Sequence[str]) -> None:
        """Raises DataError where a column is missing."""
        for name in names:
            if name not in self.names:
                meant = close(name, self.names)
                hint = "" if meant is None else f"; did you mean {meant}?"
                raise DataError(f"{self.path}, column {name!r}: the column is missing{hint}")

    def rows(self) -> Iterator[tuple[int, list[str]]]:
        """Every line's number and its cells; empty lines and comments are left out."""
        lines = io.StringIO(self.body, newline="")
        told = ("\n" if self.comment and line.startswith(self.comment) else line for line in lines)
        if not self.delimiter:
            for number, line in enumerate(told, self.first + 1):
                if cells := line.split():
                    yield number, cells
            return
        reader = csv.reader(told, delimiter=self.delimiter, skipinitialspace=self.delimiter != "\t")
        try:
            for row in reader:
                if any(cell.strip() for cell in row):
                    yield self.first + reader.line_num, row
        except csv.Error as error:
            raise DataError(f"{self.path}: is not a CSV text file ({error})") from error

    def with_decimal(self) -> Sheet:
        """The same, with the decimal mark that its first lines show."""
        if self.decimal is not None:
            return self
        told = (cells for (_, cells), _ in zip(self.rows(), range(LOOKED_AT), strict=False))
        comma = any(COMMA.fullmatch(cell.strip()) for cells in told for cell in cells)
        return replace(self, decimal="," if comma else ".")

    def table(self, only: Sequence[str] | None = None, words: Sequence[str] = ()) -> CsvTable:
        """The numbers.

        Args:
            only: Columns to read; None: all but those of `words`.
            words: Columns that hold text.

        Raises:
            DataError: There is no data, a column is missing or there twice, a line is short or holds text in a column
                that is read.
        """
        sheet = self.with_decimal()
        names = [*sheet.names]
        only = [name for name in names if name not in words] if only is None else list(dict.fromkeys(only))
        sheet.require([*only, *words])
        counts = Counter(names)
        for name in (*only, *words):
            if name and counts[name] > 1:
                raise DataError(f"{self.path}, column {name!r}: the column is there more than once")
        at = [names.index(name) for name in only]
        lines: list[int] = []
        rows: list[list[float]] = []
        texts: dict[str, list[str]] = {name: [] for name in words}
        for line, cells in sheet.rows():
            if len(cells) < len(names) or any(cell.strip() for cell in cells[len(names) :]):
                raise DataError(
                    f"{self.path}, line {line}: the line has {len(cells)} cells where the header has {len(names)} "
                    f"(from column {names[min(len(cells), len(names) - 1)]!r} on)"
                )
            try:
                rows.append([_number(cells[i], sheet.decimal) for i in at])
            except ValueError:
                raise sheet.not_a_number(cells, at, line) from None
            for name in words:
                texts[name].append(cells[names.index(name)])
            lines.append(line)
        if not rows:
            raise DataError(f"{self.path}: holds no data lines")
        values = torch.tensor(rows, dtype=torch.float64).view(len(rows), len(at))
        return CsvTable(self.path, {name: i for i, name in enumerate(only)}, lines, values, texts)

    def not_a_number(self, cells: Sequence[str], at: Sequence[int], line: int) -> DataError:
        """The error to raise where one of the cells is no number."""
        for i in at:
            try:
                _number(cells[i], self.decimal)
            except ValueError:
                mark = "; write recording.decimal: ','" if COMMA.fullmatch(cells[i].strip()) else ""
                return DataError(
                    f"{self.path}, column {self.names[i]!r}, line {line}: {cells[i]!r} is not a number{mark}"
                )
        raise AssertionError("every cell is a number")


def _number(cell: str, decimal: str | None) -> float:
    text = cell.strip()
    if text.lower() in EMPTY:
        return math.nan
    if decimal == ",":
        if "." in text:
            raise ValueError(text)
        text = text.replace(",", ".")
    return float(text)


def text_of(path: Path) -> str:
    """The text of a recording, without a byte order mark.

    Raises:
        DataError: It cannot be read.
    """
    return read_text(path, MOST_TABLE, str(path)).removeprefix("\ufeff")


def sheet_of(
    path: Path, text: str, delimiter: str | None = None, decimal: str | None = None, comment: str = ""
) -> Sheet:
    """A table whose first line names its columns; where that line is a comment, the comment does.

    Args:
        path: Its file.
        text: What the file holds.
        delimiter: Between cells: a character, "tab" or "blank"; None: the one in the header.
        decimal: Mark in numbers; None: as the cells show.
        comment: What begins a line that is none of the table's.

    Raises:
        DataError: It holds no data, or no names of columns.
    """
    at, number, before = 0, 0, ""
    while True:
        if at >= len(text):
            raise DataError(f"{path}: holds no data lines")
        start, at, number = at, text.find("\n", at) + 1 or len(text), number + 1
        line = text[start:at].strip("\r\n")
        if comment and line.startswith(comment):
            before = line[len(comment) :].strip()
        elif line.strip():
            break
    mark = _delimiter(line, delimiter)
    names = cells_of(path, line, mark)
    if all(map(_is_number, names)):
        names = cells_of(path, before, _delimiter(before, delimiter))
        if all(map(_is_number, names)):
            raise DataError(f"{path}, line {number}: holds numbers where the names of the columns are wanted")
        at, number = start, number - 1
    while len(names) > 1 and not names[-1]:
        names.pop()
    if any(len(name) > LONGEST_NAME for name in names):
        raise DataError(f"{path}, line {number}: a column's name has over {LONGEST_NAME} characters")
    return Sheet(path, tuple(names), text[at:], number, mark, decimal, comment)


def _delimiter(line: str, told: str | None) -> str:
    """The delimiter of a line; "" for blanks."""
    if told is not None:
        return DELIMITERS.get(told, told).strip(" ")
    bare = re.sub(r'"[^"]*"', "", line)
    return next((mark for mark in "\t;,|" if mark in bare), "")


def cells_of(path: Path, line: str, delimiter: str) -> list[str]:
    """The cells of a line; a delimiter of "" stands for any number of blanks.

    Raises:
        DataError: They are no cells.
    """
    if not delimiter:
        return line.split()
    try:
        return [cell.strip() for cell in next(csv.reader([line], delimiter=delimiter, skipinitialspace=True), [])]
    except csv.Error as error:
        raise DataError(f"{path}: is not a CSV text file ({error})") from error


def _is_number(cell: str) -> bool:
    try:
        _number(cell, "," if COMMA.fullmatch(cell.strip()) else ".")
    except ValueError:
        return False
    return True


def read_table(path: Path, words: Sequence[str] = ()) -> CsvTable:
    """Reads a CSV file of numbers with a header line whole; empty lines are skipped.

    Args:
        path: The file.
        words: Columns that may hold text.

    Raises:
        DataError: The file cannot be read, has no data, repeats a column, or has a line that is short or holds text.
    """
    return sheet_of(path, text_of(path), ",", ".").table(words=words)
