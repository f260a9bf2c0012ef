"""The README says what was measured."""

from __future__ import annotations

import importlib.util
import json
from pathlib import Path
from types import ModuleType

ROOT = Path(__file__).resolve().parent.parent


def readme_maker() -> ModuleType:
    spec = importlib.util.spec_from_file_location("readme", ROOT / "benchmarks" / "readme.py")
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_the_speed_table_is_the_saved_one() -> None:
    text = (ROOT / "README.md").read_text(encoding="utf-8")
    speed = json.loads((ROOT / "docs" / "speed.json").read_text(encoding="utf-8"))
    assert readme_maker().with_table(text, speed) == text


def test_times_in_words() -> None:
    spelled = readme_maker().spelled
    assert [spelled(v) for v in (0.357, 12.34, 1500.0, 2.5e6)] == ["0.357 µs", "12.3 µs", "1.5 ms", "2.5 s"]
