"""What tests of machine code share: a cache of their own, and counts of what is traced and built."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import pytest

from apcc_torch.native import kept_program
from apcc_torch.native.trace import traced


@pytest.fixture
def own_cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The folder of a cache that nobody else uses."""
    monkeypatch.setenv("APCC_CACHE", str(tmp_path / "cache"))
    return tmp_path / "cache"


@pytest.fixture
def counted(monkeypatch: pytest.MonkeyPatch) -> dict[str, int]:
    """How often something was traced and built."""
    counts = {"traced": 0, "built": 0}

    def counting(name: str, function: Callable[..., Any], *args: Any, **named: Any) -> Any:
        counts[name] += 1
        return function(*args, **named)

    monkeypatch.setattr("apcc_torch.native.function.traced", partial(counting, "traced", traced))
    monkeypatch.setattr(kept_program, "built", partial(counting, "built", kept_program.built))
    return counts
