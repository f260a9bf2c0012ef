"""The tidy table keeps every number to its last digit, in both of its files."""

from __future__ import annotations

import csv
import io
import math
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from apcc_torch.plain_text import for_spreadsheet
from apcc_torch.report import run_table
from apcc_torch.report.run_record import Run
from apcc_torch.report.run_table import differing, tidy, write_csv, write_parquet

RUNS = [
    Run("0", "complete", {"k.gain": 1, "k.mode": "pose", "n": 5, "l": [1, 2]}, metrics={"e_mm": 0.1, "wall_s": 2.0}),
    Run("1", "complete", {"k.gain": 0.3, "k.mode": None, "n": 7, "l": [1, 3]}, metrics={"f": math.inf, "wall_s": 1.0}),
    Run("2", "failed", {"k.gain": 1.0, "k.mode": True, "n": 5, "l": [1, 2]}, note="why, and more"),
]


def test_columns_are_run_status_keys_metrics_wall_time_note() -> None:
    table = tidy(RUNS)
    assert [column.name for column in table.columns] == [
        *("run", "status", "k.gain", "k.mode", "n", "l", "e_mm", "f", "wall_s", "note"),
    ]
    cells = {column.name: column.cells for column in table.columns}
    assert cells["k.gain"] == [1.0, 0.3, 1.0] and cells["n"] == [5, 7, 5] and isinstance(cells["n"][0], int)
    assert cells["k.mode"] == ["pose", None, "true"] and cells["l"] == ["[1, 2]", "[1, 3]", "[1, 2]"]
    assert cells["e_mm"] == [0.1, None, None] and cells["wall_s"] == [2.0, 1.0, None]
    assert table.column("e_mm").label == ("e", "mm") and len(table) == 3
    assert [column.name for column in differing(table)] == ["k.gain", "k.mode", "n", "l"]


def test_a_key_that_was_asked_for_but_is_the_same_is_kept() -> None:
    runs = [Run(str(k), "complete", {"a.b": 3}, {"a.b": "3"}, {"m": float(k)}) for k in range(2)]
    table = tidy(runs)
    assert table.column("a.b").cells == [3, 3] and differing(table) == []


numbers = st.one_of(st.none(), st.floats(), st.floats(min_value=-1e-300, max_value=1e-300))


def same(a: object, b: object) -> bool:
    both_nan = isinstance(a, float) and isinstance(b, float) and math.isnan(a) and math.isnan(b)
    return both_nan or a == b


texts = st.text() | st.text("=+-@0.\n\t\r\x1b\udcff a")
row_lists = st.lists(st.tuples(numbers, texts, st.integers(-(2**62), 2**62)), min_size=1, max_size=5)


@given(row_lists)
def test_files_read_back_as_they_were(
    tmp_path_factory: pytest.TempPathFactory, rows: list[tuple[float | None, str, int]]
) -> None:
    folder = tmp_path_factory.mktemp("table")
    runs = [
        Run(name, "complete", {"n": n}, {"n": str(n)}, {} if value is None else {"m": value}) for value, name, n in rows
    ]
    table = tidy(runs)
    read = list(
        csv.DictReader(io.StringIO(write_csv(table, folder / "runs.csv").read_text(encoding="utf-8"), newline=""))
    )
    assert len(read) == len(rows)
    for (value, name, n), row in zip(rows, read, strict=True):
        # Plain text is itself; what would act on a terminal or in a spreadsheet is written out.
        assert row["run"] == for_spreadsheet(run_table.line(name)) and int(row["n"]) == n
        assert not set(row["run"]) & set("\x1b\r\n\t") and (row["run"] == name or not name.isidentifier())
        assert row["run"][:1] not in ("=", "@", "+", "-") or math.isfinite(float(row["run"]))
        assert value is None or same(float(row["m"]), value)
        assert value is not None or row.get("m", "") == ""
    parquet = pytest.importorskip("pyarrow.parquet", reason="pyarrow is not installed")
    back = parquet.read_table(write_parquet(table, folder / "runs.parquet")).to_pydict()
    assert back["run"] == [row["run"] for row in read] and back["n"] == [n for _, _, n in rows]
    assert "m" not in back or all(same(a, b) for a, (b, _, _) in zip(back["m"], rows, strict=True))


def test_parquet_has_one_type_a_column(tmp_path: Path) -> None:
    parquet = pytest.importorskip("pyarrow.parquet", reason="pyarrow is not installed")
    folder = tmp_path / "a:b\udcff\n'"
    schema = parquet.read_schema(write_parquet(tidy(RUNS), folder / "runs.parquet").open("rb"))
    assert {name: str(schema.field(name).type) for name in ("n", "k.gain", "k.mode", "e_mm", "wall_s")} == {
        **{"n": "int64", "k.gain": "double", "k.mode": "string", "e_mm": "double", "wall_s": "double"},
    }
    assert [path.name for path in folder.iterdir()] == ["runs.parquet"]


def test_pyarrow_is_looked_for(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(run_table, "pyarrow", None)
    assert not run_table.has_parquet()


def test_values_that_are_called_like_other_columns_are_told_apart() -> None:
    runs = [Run("0", "complete", {"rows": 1}, {"rows": "1"}, {"run": 1.0, "note": 2.0, "rows": 3.0, "-x": 4.0})]
    table = tidy(runs)
    names = [column.name for column in table.columns]
    assert names == ["run", "status", "rows", "run (metric)", "note (metric)", "rows (metric)", "-x", "wall_s", "note"]
    assert table.column("run").cells == ["0"] and table.column("note (metric)").cells == [2.0]


@pytest.mark.parametrize("value", [2**63, -(10**400), 2**64 - 1])
def test_a_whole_number_that_no_table_holds_is_a_text(tmp_path: Path, value: int) -> None:
    runs = [Run(str(k), "complete", {"seed": seed}, {"seed": ""}) for k, seed in enumerate((value, 1.5))]
    table = tidy(runs)
    assert table.column("seed").cells == [str(value), "1.5"] and not table.column("seed").number
    assert str(value) in write_csv(table, tmp_path / "runs.csv").read_text()
    if run_table.has_parquet():
        write_parquet(table, tmp_path / "runs.parquet")
