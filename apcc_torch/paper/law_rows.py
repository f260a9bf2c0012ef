"""Laws of the rest lengths beside each other: one run's numbers, a line a law, for tables in text and in pages."""

from __future__ import annotations

from collections.abc import Mapping

COLUMNS: Mapping[str, tuple[str, str]] = {
    "shape_error_mean_mm": ("shape error, mm", "{:.2f}"),
    "shape_error_max_mm": ("largest", "{:.1f}"),
    "psi_mean_cm": ("Psi, cm", "{:.2f}"),
    "end_effector_error_end_mm": ("tip after the run, mm", "{:.2f}"),
    "mapping_error_mean_mm": ("mapping error, cm", "{:.1f}"),
    "settling_mean_s": ("settling, s", "{:.2f}"),
    "tendon_force_rms_n": ("tendon force, N", "{:.1f}"),
    "diverged_rows": ("diverged", "{:.0f}"),
}
"""Metric -> its column's title, and how its number is written."""
IN_UNITS = {"mapping_error_mean_mm": 0.1}
"""Metric -> what it is multiplied by for its column."""


LOST = "diverged_rows"
"""Metric that says of how many runs nothing else does."""


def all_lost(found: Mapping[str, float | None]) -> bool:
    """Whether every run of a law diverged: its other metrics tell when that was, and change with the last digit."""
    return found[LOST] == found["rows"]


def law_rows(cells: Mapping[str, Mapping[str, float | None]], about: Mapping[str, str]) -> list[list[str]]:
    """A line of titles, and a line a law, without numbers where all its runs diverged.

    Args:
        cells: Metric -> row -> value, as table.json has them.
        about: Row -> what it is, in the order of the lines.
    """
    lines = [["law", *(heading for heading, _ in COLUMNS.values())]]
    for row, meaning in about.items():
        line, lost = [meaning], all_lost({name: cells[name][row] for name in (LOST, "rows")})
        for metric, (_, form) in COLUMNS.items():
            value = cells[metric][row]
            if lost and metric != LOST:
                value = None
            line.append("-" if value is None else form.format(IN_UNITS.get(metric, 1.0) * value))
        lines.append(line)
    return lines
