"""The order of runs, and the summary as a terminal shows it."""

from __future__ import annotations

import math
from collections.abc import Callable

import pytest
from hypothesis import given
from hypothesis import strategies as st

from apcc_torch.errors import ValueRangeError
from apcc_torch.report.ranking import (
    best_and_worst,
    choose_metric,
    headline_columns,
    lines,
    number_text,
    ranked,
    standings,
    summary,
    without_effect,
)
from apcc_torch.report.run_record import Run
from apcc_torch.report.run_table import RunTable, tidy


def table_of(values: list[float], **more: float) -> RunTable:
    runs = [
        Run(f"r{k}", "complete", {"a.gain": k}, metrics={"shape_error_mean_mm": value, **more, "wall_s": 1.0})
        for k, value in enumerate(values)
    ]
    return tidy([*runs, Run("x", "failed", {"a.gain": 99}, note="gain is too high")])


@given(st.lists(st.floats(), min_size=1, max_size=8), st.booleans())
def test_finite_values_come_first_in_order(values: list[float], descending: bool) -> None:
    order = ranked(table_of(values), "shape_error_mean_mm", descending)
    assert sorted(order) == list(range(len(values)))
    finite = [values[k] for k in order if math.isfinite(values[k])]
    assert finite == sorted(finite, reverse=descending)
    assert all(math.isfinite(values[k]) for k in order[: len(finite)])


def test_a_run_with_diverged_rows_is_last_whatever_its_metric() -> None:
    runs = [
        Run(name, "complete", metrics={"psi_mean_cm": psi, "diverged_rows": lost})
        for name, psi, lost in (
            ("a", 3.0, 0.0),
            ("b", 1.0, 2.0),
            ("c", 2.0, 0.0),
            ("d", math.nan, 0.0),
            ("e", 0.5, 1.0),
        )
    ]
    assert ranked(tidy(runs), "psi_mean_cm") == [2, 0, 3, 4, 1]
    assert ranked(tidy(runs), "psi_mean_cm", descending=True) == [0, 2, 3, 1, 4]


def test_a_run_that_never_arrives_is_behind_those_that_do_and_says_why() -> None:
    settled = [
        Run(name, "complete", metrics={"shape_error_mean_mm": shape, "settled_share": share, "diverged_rows": lost})
        for name, shape, share, lost in (
            ("still", 0.1, 0.0, 0.0),
            ("a", 2.0, 0.5, 0.0),
            ("b", 1.0, 1.0, 0.0),
            ("c", 3.0, 1.0, 1.0),
        )
    ]
    assert ranked(tidy(settled), "shape_error_mean_mm") == [2, 1, 0, 3]
    best, worst = best_and_worst(tidy(settled), "shape_error_mean_mm")
    assert best == "best: b: its shape error mean, 1 mm, is the smallest of the 2 that arrive"
    assert worst.startswith("worst: c: 1 of its rows diverged, and its shape error mean, 3 mm, is the largest")
    assert best in summary(tidy(settled), "shape_error_mean_mm")
    tips = [
        Run(name, "complete", metrics={"shape_error_mean_mm": shape, "end_effector_error_end_mm": tip})
        for name, shape, tip in (("still", 0.1, 90.0), ("a", 2.0, 0.5), ("lost", 0.2, math.nan))
    ]
    assert ranked(tidy(tips), "shape_error_mean_mm") == [1, 0, 2]
    assert [s.why for s in standings(tidy(tips))] == [
        "its tip ends 90 mm from the target",
        "",
        "its tip ends nan mm from the target",
    ]
    assert best_and_worst(tidy(tips[:1]), "shape_error_mean_mm") == []


def test_the_metric_is_the_one_asked_for_or_the_most_telling() -> None:
    table = table_of([1.0], psi_mean_cm=2.0)
    assert choose_metric(table) == "shape_error_mean_mm" and choose_metric(table, "psi_mean_cm") == "psi_mean_cm"
    with pytest.raises(ValueRangeError, match=r"--metric must be .* such as psi_mean_cm.*; got 'psi_mean'"):
        choose_metric(table, "psi_mean")
    assert choose_metric(tidy([Run("a", "complete", metrics={"other": 1.0})])) == "other"
    with pytest.raises(ValueRangeError, match="none is complete"):
        choose_metric(tidy([Run("a", "failed")]))


def test_diverged_rows_are_shown_where_there_are_any() -> None:
    def shown(count: float) -> list[str]:
        return [column.name for column in headline_columns(table_of([1.0], diverged_rows=count), "shape_error_mean_mm")]

    assert "diverged_rows" in shown(2.0) and "diverged_rows" not in shown(0.0)


@pytest.mark.parametrize(
    ("value", "text"),
    [(None, "–"), (3.0, "3"), (0.123456, "0.1235"), (12345.6, "1.235e+04"), (5, "5"), ("pose", "pose")],
)
def test_numbers_for_people(value: object, text: str) -> None:
    assert number_text(value) == text


@given(st.integers(30, 200))
def test_lines_are_aligned_and_fit(width: int) -> None:
    columns = [
        ("run", ["a", "long name"], False),
        ("shape error mean mm", ["1", "22.5"], True),
        ("k", ["x", "y"], True),
    ]
    head, *rest = lines(columns, width)
    assert all(len(line) <= width for line in (head, *rest))
    rule = next(line for line in rest if line.startswith("-"))
    edges = [k for k, letter in enumerate(rule) if letter == "-" and rule[k + 1 : k + 2] in ("", " ")]
    first, second = rest[-2:]
    assert first.startswith("a ") and second.startswith("long name")
    if len(edges) > 1:  # numbers end where their rule ends
        assert first[: edges[1] + 1].endswith(" 1") and second[: edges[1] + 1].endswith("22.5")


def test_the_summary_names_the_best_the_worst_and_what_failed() -> None:
    text = summary(table_of([3.0, 1.0, 2.0, 4.0, 5.0]), "shape_error_mean_mm", top=2)
    rows = text.splitlines()
    assert rows[0] == "5 complete of 6 runs, by shape_error_mean_mm, smallest first"
    ranks = [row.split()[:3] for row in rows[1:] if row.strip()[:1].isdigit()]
    assert ranks == [["1", "r1", "1"], ["2", "r2", "2"], ["5", "r4", "4"]]
    assert "(2 more)" in rows and rows[-1] == "  x: failed, gain is too high"
    assert "largest first" in summary(table_of([1.0]), "shape_error_mean_mm", descending=True)


def swept(metric: Callable[[int, int], float]) -> RunTable:
    """Runs over a gain and a window, of which one failed."""
    done = [
        Run(
            f"r{a}{b}", "complete", {"a.gain": a, "b.window": b}, metrics={"psi_mean_cm": metric(a, b), "wall_s": a + b}
        )
        for a in (1, 2)
        for b in (5, 9)
    ]
    return tidy([*done, Run("x", "failed", {"a.gain": 3, "b.window": 5})])


def test_a_swept_key_that_changes_no_metric_is_named() -> None:
    said = "b.window makes no difference: runs that differ in nothing else have the same metrics."
    idle = swept(lambda a, b: 1.0 / a)
    assert without_effect(idle) == said and said in summary(idle, "psi_mean_cm").splitlines()
    assert without_effect(swept(lambda a, b: math.nan)).startswith("a.gain, b.window each make no difference")
    assert without_effect(swept(lambda a, b: a + b)) == "" and "difference" not in summary(
        swept(lambda a, b: a + b), "psi_mean_cm"
    )
    # A window that acts with one gain only does act.
    assert without_effect(swept(lambda a, b: b if a == 1 else 0.0)) == ""
    assert without_effect(table_of([1.0])) == ""
