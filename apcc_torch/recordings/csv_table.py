"""CSV files of numbers, read whole with errors that name the place."""

from __future__ import annotations

import csv
import io
import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

import torch
from torch import Tensor

from apcc_torch.errors import DataError
from apcc_torch.files import read_text

MOST_TABLE = 2**30
"""Largest recording that is read, bytes."""
LARGEST = 1e15
"""Largest number that a recording may hold: squared it is one still. Stamps are in seconds."""


@dataclass(frozen=True)
class CsvTable:
    """A CSV file of numbers; empty cells are NaN, and so are the cells of columns of words."""

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
            what = f"a number beyond {LARGEST:g}" if values[row, k].isfinite() else "no finite number"
            raise self.fault(f"the cell holds {what}", names[k], row)
        return values

    def numbered(self, stem: str) -> list[str]:
        """The columns stem1, stem2, ... up to the highest number there is, but no more than one that is missing."""
        digits = [c[len(stem) :] for c in self.columns if c.startswith(stem) and c[len(stem) :].isdecimal()]
        # Of a number too long to be read, or far above the others, the first column that is missing says enough.
        most = max((int(d) if len(d) < 9 else 10**9 for d in digits), default=0)
        return [f"{stem}{i}" for i in range(1, min(most, len(digits) + 1) + 1)]

    def optional(self, names: Sequence[str]) -> Tensor | None:
        """The named columns, or None where the file has none of them."""
        return self.finite(names) if any(name in self.columns for name in names) else None


def _number(cell: str) -> float:
    return float(cell) if cell.strip() else math.nan


def read_table(path: Path, words: Sequence[str] = ()) -> CsvTable:
    """Reads a CSV file of numbers with a header line whole; empty lines are skipped.

    Args:
        path: The file.
        words: Columns that may hold text.

    Raises:
        DataError: The file cannot be read, has no data, repeats a column, or has a line that is short or holds text.
    """
    lines: list[int] = []
    rows: list[list[float]] = []
    texts: dict[str, list[str]] = {name: [] for name in words}
    try:
        reader = csv.reader(io.StringIO(read_text(path, MOST_TABLE, str(path)).removeprefix("\ufeff"), newline=""))
        header = [name.strip() for name in next(reader, [])]
        for row in reader:
            if not row:
                continue
            if len(row) != len(header):
                since = f" (from column {header[min(len(row), len(header) - 1)]!r} on)" if header else ""
                raise DataError(
                    f"{path}, line {reader.line_num}: the line has {len(row)} cells where the header has "
                    f"{len(header)}{since}"
                )
            for name in words:
                if name not in header:
                    raise DataError(f"{path}, column {name!r}: the column is missing")
                texts[name].append(row[header.index(name)])
                row[header.index(name)] = ""
            try:
                rows.append([_number(cell) for cell in row])
            except ValueError:
                raise _not_a_number(path, header, row, reader.line_num) from None
            lines.append(reader.line_num)
    except csv.Error as error:
        raise DataError(f"{path}: is not a CSV text file ({error})") from error
    if not rows:
        raise DataError(f"{path}: holds no data lines")
    columns: dict[str, int] = {}
    for i, name in enumerate(header):
        if name in columns:
            raise DataError(f"{path}, column {name!r}: the column is there more than once")
        columns[name] = i
    return CsvTable(path, columns, lines, torch.tensor(rows, dtype=torch.float64), texts)


def _not_a_number(path: Path, header: list[str], row: list[str], line: int) -> DataError:
    for name, cell in zip(header, row, strict=True):
        try:
            _number(cell)
        except ValueError:
            return DataError(f"{path}, column {name!r}, line {line}: {cell!r} is not a number")
    raise AssertionError("every cell is a number")
