"""The benchmark's numbers as table.json, as flat metrics, and as the text that stands beside the paper's numbers."""

from __future__ import annotations

from collections.abc import Mapping
from math import isfinite

from apcc_torch.paper.law_rows import law_rows
from apcc_torch.paper.outcomes import HELD_OUT, SINGLE, Outcome, Outcomes
from apcc_torch.paper.printed_numbers import LEFT_OUT, PUBLISHED, TITLES, Published, published
from apcc_torch.paper.regret import MANY, regret_rows
from apcc_torch.report.text_table import aligned

Cell = dict[str, float | None]

LABELS: Mapping[str, str] = {
    "shape_error_mean_mm": "shape error, mean (mm)",
    "shape_error_min_mm": "shape error, min (mm)",
    "shape_error_max_mm": "shape error, max (mm)",
    "shape_error_lower_edge_mm": "  lower edge over time",
    "shape_error_upper_edge_mm": "  upper edge over time",
    "psi_mean_cm": "Psi, mean (cm)",
    "psi_min_cm": "Psi, min (cm)",
    "psi_max_cm": "Psi, max (cm)",
    "psi_lower_edge_cm": "  lower edge over time",
    "psi_upper_edge_cm": "  upper edge over time",
    "sensor_error_linear_mean_mm": "sensors, linear (mm)",
    "sensor_1_error_linear_mean_mm": "  sensor 1",
    "sensor_2_error_linear_mean_mm": "  sensor 2",
    "sensor_3_error_linear_mean_mm": "  sensor 3",
    "sensor_error_angular_mean_rad": "sensors, angular (rad)",
    "sensor_1_error_angular_mean_rad": "  sensor 1",
    "sensor_2_error_angular_mean_rad": "  sensor 2",
    "sensor_3_error_angular_mean_rad": "  sensor 3",
    "end_effector_error_end_mm": "tip error at the end, mean (mm)",
    "end_effector_error_end_max_mm": "tip error at the end, max (mm)",
    "settling_mean_s": "settling to 10 mm (s)",
    "settled_share": "settled at the end (share)",
    "mapping_error_mean_mm": "mapping error, Eq. (53), mean (mm)",
    "mapping_error_end_mm": "mapping error at the end (mm)",
    "tendon_force_rms_n": "tendon force, rms (N)",
    "diverged_rows": "diverged rows",
}
"""Metric -> its name in the text, in the text's order."""

HEADLINES = ("shape_error_mean_mm", "shape_error_max_mm", "psi_mean_cm", "end_effector_error_end_mm", "diverged_rows")
"""What the text shows of held-out set-points and of single runs that the paper has no numbers for."""

NOTHING = 1e-9
"""A value below this is rounding: the arm hangs straight at first, where the model's shape is exact."""
COLUMNS = ("metric", "paper standard", "paper adaptive", "paper, %",
           "ours standard", "ours adaptive", "ours, %", "limit", "own limit", "paper's figure")  # fmt: skip


def change_percent(standard: float, adaptive: float) -> float | None:
    """How much the adaptive controller's value is above the standard one's, percent; None where there is no telling."""
    if not (isfinite(standard) and isfinite(adaptive)) or abs(standard) < NOTHING:
        return None
    return 100.0 * (adaptive - standard) / standard


def gap_closed_percent(standard: float, adaptive: float, limit: float) -> float | None:
    """How much of the way from the standard controller's value to the limit is gone; None where there is no way."""
    gap = standard - limit
    return 100.0 * (standard - adaptive) / gap if isfinite(gap) and isfinite(adaptive) and gap > NOTHING else None


def cell(
    standard: float,
    adaptive: float,
    limit: float | None = None,
    own_limit: float | None = None,
    others: Mapping[str, float] | None = None,
) -> Cell:
    """One entry of table.json.

    `limit` is the best that any rest lengths could reach on the motion under the standard controller, `own_limit` on
    that under the adaptive one, see `paper_limits`; None for a metric that has none. `others` are the further rows of a
    comparison of laws; without them there is no `best_constant` to tell.
    """
    return {
        "standard": standard if isfinite(standard) else None,
        "adaptive": adaptive if isfinite(adaptive) else None,
        "limit": limit,
        "own_limit": own_limit,
        "best_constant": None,
        **{name: value if isfinite(value) else None for name, value in (others or {}).items()},
        "change_percent": change_percent(standard, adaptive),
        "gap_closed_percent": None if limit is None else gap_closed_percent(standard, adaptive, limit),
    }


def run_cells(rows: Mapping[str, Outcome]) -> dict[str, Cell]:
    """Metric -> cell of one run; the time taken is no result."""
    standard, adaptive = rows["standard"].metrics, rows["adaptive"].metrics
    limit, own = ({} if o.limits is None else o.limits.metrics() for o in (rows["standard"], rows["adaptive"]))
    others = {name: o.metrics for name, o in rows.items() if name not in ("standard", "adaptive")}
    return {
        name: cell(
            standard[name], adaptive[name], limit.get(name), own.get(name), {row: m[name] for row, m in others.items()}
        )
        for name in standard
        if name != "wall_s" and name in adaptive
    }


def table(results: Mapping[str, Outcomes]) -> dict[str, dict[str, dict[str, Cell]]]:
    """{comparison: {run: {metric: {standard, adaptive, limit, own_limit, best_constant, change_percent, ...}}}}."""
    return {
        comparison: {run: run_cells(both) for run, both in outcomes.items()} for comparison, outcomes in results.items()
    }


def flat_metrics(results: Mapping[str, Outcomes]) -> dict[str, float]:
    """run_controller_metric -> value; comparisons other than A say so in front."""
    return {
        f"{'' if comparison == 'A' else comparison + '_'}{run}_{controller}_{metric}": value
        for comparison, outcomes in results.items()
        for run, both in outcomes.items()
        for controller, o in both.items()
        for metric, value in o.metrics.items()
    }


def title(run: str, o: Outcome) -> str:
    """What a run is, how many rows it has and how long they last."""
    for suffix, words in ((HELD_OUT, ", held-out set-points"), (SINGLE, ", the named set-point, largest payload")):
        if run.endswith(suffix):
            base = run.removesuffix(suffix)
            return f"{run}: {TITLES.get(base, base)}{words} ({_size(o)})"
    return f"{run}: {TITLES.get(run, run)} ({_size(o)})"


def _size(o: Outcome) -> str:
    rows = o.curves.e.shape[1]
    return f"{rows} {'run' if rows == 1 else 'runs'} of {float(o.curves.time[-1]):g} s a controller"


def number(value: float | None) -> str:
    """Four significant digits; 0 for rounding, a dash for nothing."""
    if value is None:
        return "-"
    return "0" if abs(value) < NOTHING else f"{value:.4g}"


def percent(value: float | tuple[float, float] | None) -> str:
    """One decimal and a sign; "least to largest" for a pair."""
    if value is None:
        return "-"
    if isinstance(value, tuple):
        return f"{value[0]:+.0f} to {value[1]:+.0f}"
    return f"{value:+.1f}"


def text(
    results: Mapping[str, Outcomes],
    about: Mapping[str, str] | None = None,
    laws: Mapping[str, Mapping[str, str]] | None = None,
) -> str:
    """The tables as text: laws beside each other, and the paper's numbers beside ours, run by run, with notes below.

    Args:
        results: Comparison -> run -> row -> outcome.
        about: Comparison -> what it compares, in words.
        laws: Comparison of laws -> row -> what it is.
    """
    laws, about = laws or {}, about or {}
    told = [
        f"Comparison {name}: {about.get(name, '')}\n\n{law_text(outcomes, laws[name])}"
        for name, outcomes in results.items()
        if name in laws
    ]
    pairs = {name: outcomes for name, outcomes in results.items() if name not in laws}
    return "\n".join([*told, pair_text(pairs, about)] if pairs else told)


def law_text(outcomes: Outcomes, about: Mapping[str, str]) -> str:
    """Laws beside each other, a table a run; of many runs a line each."""
    whole = {run: rows for run, rows in outcomes.items() if not run.endswith((HELD_OUT, SINGLE))}
    parts = []
    if len(whole) > MANY:
        parts.append(aligned(regret_rows({run: run_cells(rows) for run, rows in whole.items()})))
        outcomes = {}
    for run, rows in outcomes.items():
        if run.endswith(SINGLE):
            continue
        table = law_rows(run_cells(rows), about)
        found = [f"  {name}: {o.found.told()}" for name, o in rows.items() if o.found is not None]
        parts.append("\n".join([title(run, rows["standard"]), aligned(table), *found]))
    return "\n\n".join(parts) + "\n"


def pair_text(results: Mapping[str, Outcomes], about: Mapping[str, str]) -> str:
    """Standard and adaptive controllers, the paper's numbers beside ours."""
    notes: list[str] = []
    lines: list[tuple[str, ...] | str] = []
    for comparison, outcomes in results.items():
        meaning = about.get(comparison, "")
        lines += ["", f"Comparison {comparison}{': ' + meaning if meaning else ''}"]
        for run, both in outcomes.items():
            lines += ["", title(run, both["standard"]), *_rows(run, run_cells(both), notes)]
            if run in LEFT_OUT:
                lines.append(f"  ({LEFT_OUT[run]})")
    rows = (COLUMNS, *(line for line in lines if isinstance(line, tuple)))
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]

    def laid(row: tuple[str, ...]) -> str:
        middle = (word.rjust(width) for word, width in zip(row[1:-1], widths[1:-1], strict=True))
        return " | ".join((row[0].ljust(widths[0]), *middle, row[-1])).rstrip()

    rule = "-+-".join("-" * width for width in widths)
    body = [line if isinstance(line, str) else laid(line) for line in lines]
    legend = [
        "", "Means, minima and maxima are over all runs and moments; an edge over time is the least or largest of the",
        "runs, averaged over time. The limit is the least that any rest lengths could leave on the motion under the",
        "standard controller, each metric by itself; the own limit that on the motion under the adaptive controller,",
        "which is another: a law that moves the arm may pass the first. Limits of Psi and sensors are algorithm 2's:",
        "a law that follows the shape may pass both. A diverged run stays in, and is counted.",
        *(f"[{i + 1}] {note}" for i, note in enumerate(notes)),
    ]  # fmt: skip
    return "\n".join([laid(COLUMNS), rule, *body, *legend]) + "\n"


def _rows(run: str, cells: Mapping[str, Cell], notes: list[str]) -> list[tuple[str, ...]]:
    part = run.endswith((HELD_OUT, SINGLE))
    shown = HEADLINES if part and run not in PUBLISHED else tuple(LABELS)
    rows: list[tuple[str, ...]] = []
    for metric in shown:
        if metric not in cells:
            continue
        if "_edge_" in metric and run.endswith(SINGLE):
            continue  # the edges over one run are its mean
        ours, paper = cells[metric], published(run, metric) or Published(None, None, None, "")
        source = paper.source
        if paper.note:
            if paper.note not in notes:
                notes.append(paper.note)
            source += f" [{notes.index(paper.note) + 1}]"
        rows.append(
            (
                LABELS[metric], number(paper.standard), number(paper.adaptive), percent(paper.change),
                number(ours["standard"]), number(ours["adaptive"]), percent(ours["change_percent"]),
                number(ours["limit"]), number(ours["own_limit"]), source,
            )
        )  # fmt: skip
    return rows
