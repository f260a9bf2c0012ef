"""The points of a batch, a sweep computed as rows of one tensor batch: one run for each line of its points.csv."""

from __future__ import annotations

import csv
import io
import os
from collections import ChainMap
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

from apcc_torch.errors import DataError
from apcc_torch.files import read_text
from apcc_torch.report.run_record import COMPLETE, FAILED, Run
from apcc_torch.report.settings import scalar

POINTS = "points.csv"
MOST_POINTS = 2**28
"""Largest table of points that is read, bytes."""


def read_points(folder: Path, batch: Run, prefix: str) -> Iterator[Run]:
    """One run for each row of points.csv.

    A column named like a setting, or a group of them, is a swept key, every other one but `point` a metric. A point
    without any metric has failed.

    Args:
        folder: The batch's; points/ID in it holds the trajectory of point ID where one was kept.
        batch: What all points share.
        prefix: What stands before points/ID in their names.

    Raises:
        DataError: The file cannot be read, a row is too short, or a metric is not a number.
    """
    reader = csv.reader(io.StringIO(read_text(folder / POINTS, MOST_POINTS), newline=""))
    try:
        header = next(reader, [])
        rows = list(reader)
    except csv.Error as error:
        raise DataError(f"{POINTS} cannot be read: {error}") from error
    if "point" not in header or len(set(header)) < len(header):
        raise DataError(f"{POINTS} must have a column named point, and no two of one name")
    groups = {key[:k] for key in batch.settings for k, letter in enumerate(key) if letter == "."}
    own = tuple(column for column in header if "." in column or column in batch.settings or column in groups)
    kept = folder / "points"
    with_folder = set(os.listdir(kept)) if kept.is_dir() else set()
    base = dict(batch.settings)  # one for all points: they differ in few keys
    for line, row in enumerate(rows, start=2):
        if len(row) != len(header):
            raise DataError(f"{POINTS} must have {len(header)} entries in line {line}, got {len(row)}")
        entry = dict(zip(header, row, strict=True))
        point = entry.pop("point")
        keys: dict[str, object] = {key: scalar(entry.pop(key)) for key in own}
        metrics = {metric: _number(metric, text, line) for metric, text in entry.items() if text != ""}
        yield replace(
            batch,
            name=f"{prefix}points/{point}",
            status=COMPLETE if metrics else FAILED,
            note="" if metrics else "the point has no metrics; the batch's log says why",
            settings=ChainMap(keys, base),
            metrics=metrics,
            own=own,
            folder=kept / point if point in with_folder else None,
        )


def _number(metric: str, text: str, line: int) -> float:
    try:
        return float(text)
    except ValueError as error:
        raise DataError(f"{POINTS} must hold a number for {metric} in line {line}, got {text!r}") from error
