"""Section V-B beside the paper in its page: `python benchmarks/paper_numbers.py FOLDER` fills in docs/dynamics.md.

FOLDER is that of a benchmark with its comparisons A and B:

    python -m apcc_torch.benchmark figures=false hydra.run.dir=FOLDER 'experiments.common=["compile=aot"]'
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Mapping
from pathlib import Path
from typing import NamedTuple

from page import between

from apcc_torch.files import write_atomically
from apcc_torch.paper.printed_numbers import published
from apcc_torch.report.text_table import as_markdown

ROOT = Path(__file__).resolve().parent.parent
PAGE = ROOT / "docs" / "dynamics.md"
BEGIN, END = "<!-- paper: python benchmarks/paper_numbers.py FOLDER -->", "<!-- /paper -->"
RUNS = {
    "run I (positions)": ("A", "run_1"),
    "run II (poses, 1 m/rad)": ("A", "run_2"),
    "run II (`dynamic_run_2_tuned`)": ("B", "run_2"),
    "arm 2 (poses, 1 m/rad)": ("A", "robot_2"),
}
"""Title -> comparison and run. The paper's numbers are of comparison A."""
ROWS = ("standard", "adaptive")

Table = Mapping[str, Mapping[str, Mapping[str, Mapping[str, float | None]]]]


class Line(NamedTuple):
    """A line of the table. metrics: One or, side by side, several. factor: From the metric's unit to the line's."""

    title: str
    metrics: tuple[str, ...]
    factor: float
    form: str


SENSORS = range(1, 4)
LINES = (
    Line("shape error, mean, mm", ("shape_error_mean_mm",), 1.0, "{:.2f}"),
    Line("shape error, upper edge over time, mm", ("shape_error_upper_edge_mm",), 1.0, "{:.1f}"),
    Line("Psi, mean, cm", ("psi_mean_cm",), 1.0, "{:.2f}"),
    Line("Psi, upper edge over time, cm", ("psi_upper_edge_cm",), 1.0, "{:.1f}"),
    Line("sensors, linear, cm", tuple(f"sensor_{i}_error_linear_mean_mm" for i in SENSORS), 0.1, "{:.1f}"),
    Line("sensors, angular, crad", tuple(f"sensor_{i}_error_angular_mean_rad" for i in SENSORS), 100.0, "{:.1f}"),
    Line("mapping error, Eq. (53), cm", ("mapping_error_mean_mm",), 0.1, "{:.1f}"),
    Line("tip after the run, mm", ("end_effector_error_end_mm",), 1.0, "{:.2f}"),
    Line("diverged rows", ("diverged_rows",), 1.0, "{:.0f}"),
)


def cell(table: Table, line: Line, title: str) -> str:
    """Both controllers' numbers of a run; in brackets the paper's, where it gives any."""
    comparison, run = RUNS[title]
    told = []
    for row in ROWS:
        numbers = [table[comparison][run][metric][row] for metric in line.metrics]
        told.append(", ".join("-" if n is None else line.form.format(line.factor * n) for n in numbers))
    printed = published(run, line.metrics[0]) if comparison == "A" and len(line.metrics) == 1 else None
    paper = "" if printed is None else _papers(line, printed.standard, printed.adaptive, printed.change)
    return " → ".join(told) + paper


def _papers(
    line: Line, standard: float | None, adaptive: float | None, change: float | tuple[float, float] | None
) -> str:
    if standard is not None and adaptive is not None:
        return " ({} → {})".format(*(line.form.format(line.factor * n) for n in (standard, adaptive)))
    return f" ({change:+.0f} %)" if isinstance(change, float) else ""


def main() -> None:
    """Writes the page."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path, help="of a benchmark")
    table = json.loads((parser.parse_args().folder / "table.json").read_text())
    lines = [["", *RUNS], *([line.title, *(cell(table, line, title) for title in RUNS)] for line in LINES)]
    write_atomically(PAGE, between(PAGE.read_text(encoding="utf-8"), BEGIN, END, as_markdown(lines)))


if __name__ == "__main__":
    main()
