"""Which runs are best: their order by a metric, and the summary that a terminal shows."""

from __future__ import annotations

import difflib
import math
import textwrap
from collections.abc import Sequence
from typing import NamedTuple

from apcc_torch.errors import ValueRangeError
from apcc_torch.report.run_record import BROKEN, COMPLETE, FAILED, PRUNED, UNFINISHED
from apcc_torch.report.run_table import METRIC, WALL, Column, RunTable, differing
from apcc_torch.report.settings import comparable

HEADLINES = (
    "shape_error_mean_mm",
    "end_effector_error_end_mm",
    "end_effector_error_last5s_max_mm",
    "shape_error_end_mm",
    "shape_error_last5s_max_mm",
    "pi_error_end_max_mm",
    "pi_drift_end_max_mm",
    "psi_mean_cm",
    "sensor_error_linear_mean_mm",
    "settled_share",
    "settling_mean_s",
)
"""The metrics that say most, first the one that ranks unless another is asked for."""
DIVERGED = "diverged_rows"
"""A run with any ranks last, whatever its other metrics are."""
SETTLED, TIP = "settled_share", "end_effector_error_end_mm"
ARRIVED = 10.0
"""Tip error at the end, mm, with which a run has come to its target, where it does not say what share has settled."""
HIGHER_IS_BETTER = ("settled_share",)
LISTED = 10
"""Most runs that the terminal remarks on."""


def choose_metric(table: RunTable, asked: str | None = None) -> str:
    """The metric that ranks: the one asked for, else the first headline that any run has, else the first metric.

    Raises:
        ValueRangeError: No run has the metric asked for, or any.
    """
    names = [column.name for column in table.of_kind(METRIC) if any(cell is not None for cell in column.cells)]
    if asked in names:
        return asked
    if asked is not None:
        near = difflib.get_close_matches(asked, names, 3, 0.4) or names[:3]
        raise ValueRangeError(f"--metric must be a metric of the runs, such as {', '.join(near)}; got {asked!r}")
    if not names:
        raise ValueRangeError("RUNS must hold at least one complete run, to rank by its metrics; none is complete")
    return next((name for name in HEADLINES if name in names), names[0])


def headline_columns(table: RunTable, metric: str) -> list[Column]:
    """The ranking metric and the headlines the runs have, then wall time; diverged rows where there are any."""
    present = {column.name: column for column in table.of_kind(METRIC)}
    diverged = present.get(DIVERGED)
    names = [metric, *HEADLINES]
    if diverged is not None and any(diverged.cells):
        names.insert(1, DIVERGED)
    return [present[name] for name in dict.fromkeys([*names, WALL]) if name in present]


class Standing(NamedTuple):
    """Whether a run's numbers can be held against others'.

    level: 0 yes; 1 its tip never comes to its target; 2 it diverged. Higher ones rank behind lower ones.
    why: In words; "" at level 0.
    """

    level: int = 0
    why: str = ""


def standings(table: RunTable) -> list[Standing]:
    """Of every run: one that hardly moves has a small shape error, and is no good for that."""
    cells = {column.name: column.cells for column in table.of_kind(METRIC)}
    none: list[object] = [None] * len(table)
    diverged, settled, tip = (cells.get(name, none) for name in (DIVERGED, SETTLED, TIP))
    found = []
    for lost, share, error in zip(diverged, settled, tip, strict=True):
        if lost:
            found.append(Standing(2, f"{number_text(lost)} of its rows diverged"))
        elif isinstance(share, int | float):
            found.append(Standing(1, "none of its rows comes to its target") if share == 0 else Standing())
        elif isinstance(error, int | float) and not error <= ARRIVED:
            found.append(Standing(1, f"its tip ends {number_text(float(error))} mm from the target"))
        else:
            found.append(Standing())
    return found


def ranked(table: RunTable, metric: str, descending: bool = False) -> list[int]:
    """Row numbers of the complete runs from best to worst.

    Behind those that come to their target stand those that never do, and behind them those that diverged; what has no
    finite value comes last among its like.
    """
    cells, standing = table.column(metric).cells, standings(table)
    complete = [k for k, status in enumerate(table.column("status").cells) if status == COMPLETE]

    def place(k: int) -> tuple[int, bool, float]:
        value = cells[k]
        finite = isinstance(value, int | float) and math.isfinite(value)
        signed = (-1.0 if descending else 1.0) * float(value) if finite else 0.0  # type: ignore[arg-type]
        return standing[k].level, not finite, signed

    return sorted(complete, key=place)


def best_and_worst(table: RunTable, metric: str, descending: bool = False) -> list[str]:
    """Why the first run is the best and the last one the worst, a sentence each; nothing of fewer than two runs."""
    order = ranked(table, metric, descending)
    if len(order) < 2:
        return []
    column, runs, standing = table.column(metric), table.column("run").cells, standings(table)
    ways = ("largest", "smallest") if descending else ("smallest", "largest")
    told = []
    for word, k, way in zip(("best", "worst"), (order[0], order[-1]), ways, strict=True):
        like = sum(standing[other].level == standing[k].level for other in order)
        why = f"{standing[k].why}, and " if standing[k].why else ""
        words, value = column.label.words, f"{number_text(column.cells[k])} {column.label.unit}".rstrip()
        among = "" if like == len(order) else f" of the {like} like it" if why else f" of the {like} that arrive"
        told.append(f"{word}: {runs[k]}: {why}its {words}, {value}, is the {way}{among}")
    return told


def number_text(value: object) -> str:
    """A cell for people: four significant digits, whole numbers whole, a dash for none."""
    if value is None:
        return "–"
    if isinstance(value, float):
        return f"{value:.4g}"
    return str(value)


def lines(columns: Sequence[tuple[str, list[str], bool]], width: int) -> list[str]:
    """Columns of (head, cells, whether right-aligned) as lines of text; those that do not fit are left out.

    A head of several words is broken over lines, so that the column is little wider than its cells.
    """
    kept: list[tuple[list[str], list[str], bool, int]] = []
    used = 0
    for head, cells, right in columns:
        size = max(len(text) for text in (*head.split(" "), *cells))
        stack = textwrap.wrap(head, max(size, 11), break_on_hyphens=False)
        size = max(len(text) for text in (*stack, *cells))
        if kept and used + 2 + size > width:
            continue
        used += size + (2 if kept else 0)
        kept.append((stack, cells, right, size))
    depth = max(len(stack) for stack, _, _, _ in kept)
    padded = [
        [text.rjust(size) if right else text.ljust(size) for text in [""] * (depth - len(stack)) + stack]
        + ["-" * size]
        + [text.rjust(size) if right else text.ljust(size) for text in cells]
        for stack, cells, right, size in kept
    ]
    return ["  ".join(row).rstrip() for row in zip(*padded, strict=True)]


def summary(table: RunTable, metric: str, top: int = 10, descending: bool = False, width: int = 100) -> str:
    """The ranked runs as plain text: the best `top`, the worst one, and remarks on runs that are not whole.

    Args:
        table: The runs.
        metric: Ranks them.
        top: How many to show.
        descending: Whether the largest value is the best.
        width: Characters a line; columns that do not fit are left out, the least telling first.
    """
    order = ranked(table, metric, descending)
    shown = order if len(order) <= top + 1 else [*order[:top], order[-1]]
    place = {k: str(n + 1) for n, k in enumerate(order)}
    first, *others = headline_columns(table, metric)
    runs = table.column("run")
    columns = [("rank", [place[k] for k in shown], True), ("run", [str(runs.cells[k]) for k in shown], False)]
    for column in [*differing(table), first, *others]:
        head = column.name.replace("_", " ") if column.kind == METRIC else column.name.replace(".", ". ")
        columns.append((head, [number_text(column.cells[k]) for k in shown], column.number))
    body = lines(columns, width)
    if len(shown) < len(order):
        body.insert(-1, f"({len(order) - len(shown)} more)")
    way = "largest" if descending else "smallest"
    head = f"{len(order)} complete of {len(table)} runs, by {metric}, {way} first"
    why = best_and_worst(table, metric, descending)
    parts = [head, "", *body, *(["", *why] if why else [])]
    return "\n".join([*parts, *([f"\n{idle}"] if (idle := without_effect(table)) else []), *remarks(table)])


def without_effect(table: RunTable) -> str:
    """A sentence that names the swept keys which change no metric of the complete runs; "" where each changes one."""
    swept, metrics = differing(table), [column for column in table.of_kind(METRIC) if column.name != WALL]
    complete = [k for k, status in enumerate(table.column("status").cells) if status == COMPLETE]
    idle = [column.name for column in swept if metrics and _is_idle(column, swept, metrics, complete)]
    if not idle:
        return ""
    what = f"{', '.join(idle)} {'makes' if len(idle) == 1 else 'each make'} no difference"
    return f"{what}: runs that differ in nothing else have the same metrics."


def _is_idle(key: Column, swept: Sequence[Column], metrics: Sequence[Column], rows: Sequence[int]) -> bool:
    """Whether there are runs that differ in a key alone, and all of them have the same metrics."""
    alike: dict[tuple[object, ...], list[int]] = {}
    for k in rows:
        alike.setdefault(tuple(comparable(other.cells[k]) for other in swept if other is not key), []).append(k)
    pairs = [(group[0], k) for group in alike.values() for k in group if key.cells[k] != key.cells[group[0]]]
    return bool(pairs) and all(_same(column.cells[a], column.cells[b]) for a, b in pairs for column in metrics)


def _same(a: object, b: object) -> bool:
    if isinstance(a, int | float) and isinstance(b, int | float):
        # Rows of one batch and runs of their own differ in their last digits.
        return math.isclose(a, b, rel_tol=1e-9) or (math.isnan(a) and math.isnan(b))
    return a == b


def remarks(table: RunTable) -> list[str]:
    """A line for each run that is not complete or lacks something, failed ones first."""
    cells = zip(*(table.column(name).cells for name in ("run", "status", "note")), strict=True)
    order = (FAILED, BROKEN, UNFINISHED, PRUNED, COMPLETE)
    rows = sorted((row for row in cells if row[1] != COMPLETE or row[2]), key=lambda row: order.index(str(row[1])))
    if not rows:
        return []
    told = [f"  {run}: {status}, {note}" if note else f"  {run}: {status}" for run, status, note in rows[:LISTED]]
    more = [f"  … and {len(rows) - LISTED} more"] if len(rows) > LISTED else []
    return ["", f"to look at ({len(rows)}):", *told, *more]
