"""One law on many arms: how far it is from the best constant lengths, and from adapting nothing."""

from __future__ import annotations

from collections.abc import Mapping

Cells = Mapping[str, Mapping[str, float | None]]
"""Metric -> row -> value, as table.json has them."""

SHAPE, PSI, TIP = "shape_error_last5s_mean_mm", "psi_mean_cm", "end_effector_error_end_mm"
ROWS = ("standard", "best_constant", "adaptive")
MANY = 4
"""More runs than this are a line each of one table, not a table each."""


def regret_rows(runs: Mapping[str, Cells]) -> list[list[str]]:
    """A line of titles, a line a run, and the means of the ratios.

    The shape error is the mean of the last 5 s, of fixed nominal lengths, of the best constant ones in hindsight and of
    the law; then the law's over both. Psi is the mean of the run, the tip's error that of its end, without and with the
    law.

    Args:
        runs: Run -> its cells.
    """
    lines = [["run", "fixed", "constant", "law", "law/constant", "law/fixed", "Psi, cm", "tip, mm", "diverged"]]
    over_constant, over_fixed = [], []
    for run, cells in runs.items():
        fixed, constant, law = (_number(cells[SHAPE][row]) for row in ROWS)
        over_constant.append(law / constant)
        over_fixed.append(law / fixed)
        pairs = [" -> ".join(f"{_number(cells[m][row]):.2f}" for row in (ROWS[0], ROWS[2])) for m in (PSI, TIP)]
        lost = f"{_number(cells['diverged_rows'][ROWS[2]]):.0f}"
        shapes = [f"{value:.2f}" for value in (fixed, constant, law, law / constant, law / fixed)]
        lines.append([run.replace("_", " "), *shapes, *pairs, lost])
    mean = [f"{sum(ratios) / len(ratios):.2f}" for ratios in (over_constant, over_fixed)]
    return [*lines, ["mean", "", "", "", *mean, "", "", ""]]


def _number(value: float | None) -> float:
    return float("nan") if value is None else value
