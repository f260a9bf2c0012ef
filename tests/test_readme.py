"""The README says what was measured."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
import readme

ROOT = Path(__file__).resolve().parent.parent


@pytest.mark.parametrize(("page", "whole"), [("README.md", False), ("docs/speed.md", True)])
def test_the_speed_tables_are_the_saved_one(page: str, whole: bool) -> None:
    text = (ROOT / page).read_text(encoding="utf-8")
    speed = json.loads((ROOT / "docs" / "speed.json").read_text(encoding="utf-8"))
    assert readme.with_table(text, speed, whole) == text


def test_times_in_words() -> None:
    spelled = readme.spelled
    assert [spelled(v) for v in (0.357, 12.34, 1500.0, 2.5e6)] == ["0.357 µs", "12.3 µs", "1.5 ms", "2.5 s"]
