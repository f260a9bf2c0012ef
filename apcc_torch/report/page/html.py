"""Fills the page: data, style and scripts into one file that needs no network."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from html import escape
from importlib import resources
from string import Template

from apcc_torch.plain_text import for_terminal
from apcc_torch.report.pictures import Picture
from apcc_torch.report.ranking import HIGHER_IS_BETTER, headline_columns, standings
from apcc_torch.report.run_table import KEY, METRIC, Cell, Column, RunTable, differing

SCRIPTS = ("data", "filter", "table", "scales", "plot", "pictures", "compare", "run", "main")
"""The scripts of assets/ in the order in which they build on each other."""
DIGITS = 7
"""Significant digits of a metric in the page; runs.csv has them all."""


@dataclass(frozen=True)
class Page:
    """What a page shows.

    title: Its heading.
    table: The runs.
    metric: The one that ranks at first.
    descending: Whether its largest value is the best.
    pictures: Row number -> the run's figures and film.
    folders: Rows whose run has a folder, from which figures could be had.
    footer: A line about how the runs were computed.
    """

    title: str
    table: RunTable
    metric: str
    descending: bool
    pictures: Mapping[int, Sequence[Picture]]
    folders: Sequence[int]
    footer: str

    def html(self) -> str:
        """The whole file."""
        template = Template(asset("page.html"))
        script = "\n".join(asset(f"{name}.js") for name in SCRIPTS)
        return template.substitute(
            title=escape(for_terminal(self.title)),
            style=asset("style.css"),
            script=script,
            data=inside_script(self.data()),
        )

    def data(self) -> dict[str, object]:
        """What the scripts read."""
        shown = {column.name for column in headline_columns(self.table, self.metric)}
        varying = {column.name for column in differing(self.table)}
        return {
            "metric": self.metric,
            "descending": self.descending,
            "higher": list(HIGHER_IS_BETTER),
            "standings": [standing._asdict() for standing in standings(self.table)],
            "footer": self.footer,
            "folders": list(self.folders),
            "pictures": {str(row): [picture._asdict() for picture in of_row] for row, of_row in self.pictures.items()},
            "columns": [
                {
                    "name": column.name,
                    "kind": column.kind,
                    "words": column.label.words,
                    "unit": column.label.unit,
                    "number": column.number,
                    "varies": column.name in varying if column.kind == KEY else column.varies,
                    "shown": column.name in shown,
                    "cells": _cells(column),
                }
                for column in self.table.columns
            ],
        }


def asset(name: str) -> str:
    """A file of the page, such as its style."""
    return (resources.files("apcc_torch.report.page") / "assets" / name).read_text(encoding="utf-8")


def _cells(column: Column) -> list[Cell]:
    """Cells as JSON can hold them: metrics rounded, what is not finite as JavaScript writes it."""
    if not column.number:
        return column.cells
    return [_number(cell, column.kind == METRIC) for cell in column.cells]


def _number(cell: Cell, rounded: bool) -> Cell:
    if not isinstance(cell, float):
        return cell
    if not math.isfinite(cell):
        return "NaN" if math.isnan(cell) else "Infinity" if cell > 0 else "-Infinity"
    value = float(f"{cell:.{DIGITS}g}") if rounded else cell
    return int(value) if value.is_integer() and abs(value) < 2**53 else value


def inside_script(data: Mapping[str, object]) -> str:
    """JSON that cannot end the script element it stands in, of any text, and so of half a pair too."""
    text = json.dumps(data, separators=(",", ":"), allow_nan=False)
    return text.replace("<", "\\u003c")
