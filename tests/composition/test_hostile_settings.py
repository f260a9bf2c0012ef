"""A file of settings from elsewhere: nothing in it is run, imported or resolved, and what is wrong is one sentence."""

from __future__ import annotations

import random
import re
import sys
from pathlib import Path

import pytest

from apcc_torch.composed import compose
from apcc_torch.composition.run_settings import SimulateSettings
from apcc_torch.composition.schema import from_text
from apcc_torch.errors import ApccError
from apcc_torch.reading import plain

VALUES = (
    "${oc.env:APCC_SECRET}", "'${arm.name}'", "evil.Law", "{kind: evil.Law}", "apcc_torch.evil.Law", "os.path.join",
    "apcc_torch.robot_log.main", "apcc_torch.", "!!python/object/apply:evil.run []", "!!binary aGk=", "!!set {a}",
    "2020-01-01", "null", "[]", "{}", "[1, [2]]", "{1: 2}", "*x", ".nan", ".inf", "1e400", "1_0", '"\\e[2J"', "\u202e",
)  # fmt: skip
LETTERS = ("\0", "\x1b", "\ud800", ":", "\t", "- ", "{", "? [a]: ")


def mutated(lines: list[str], rng: random.Random) -> str:
    """The settings with one or two lines that have another value, another key, are gone, or are torn."""
    lines = list(lines)
    for _ in range(rng.choice((1, 1, 2))):
        k = rng.randrange(len(lines))
        begin, key, value = re.match(r"(\s*(?:- )?)([\w.]+:)?(.*)", lines[k]).groups()  # type: ignore[union-attr]
        lines[k] = rng.choice(
            (
                f"{begin}{key or ''} {rng.choice(VALUES)}",
                f"{begin}{rng.choice(VALUES)}: {value}",
                "",
                lines[k][: rng.randrange(len(lines[k]) + 1)] + rng.choice(LETTERS) + lines[k],
            )
        )
    return "\n".join(lines)


def test_a_hostile_file_is_read_or_refused_and_does_nothing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "evil.py").write_text("raise SystemExit('imported')")
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.setenv("APCC_SECRET", "secret of the reader")
    lines, rng = str(compose("experiment=dynamic_run_2")).splitlines(), random.Random(5)
    read = 0
    kinds = [k for k, line in enumerate(lines) if re.match(r"\s+kind: apcc_torch", line)]
    named = ["\n".join([*lines[:k], lines[k].partition(":")[0] + ": evil.Law", *lines[k + 1 :]]) for k in kinds]
    assert len(named) == 3  # model, adaptation and plant
    for content in named + [mutated(lines, rng) for _ in range(150)]:
        try:
            told = str(plain(from_text(content, SimulateSettings)))
            read += 1
        except ApccError as error:
            told = str(error)
        assert "secret of the reader" not in told, content
    assert 10 < read < 140  # of both there are many
    assert "evil" not in sys.modules


def test_nothing_is_resolved() -> None:
    written = str(compose("experiment=kinematic")).replace("seed: 0", "data_root: ${oc.env:HOME}\nseed: 0")
    written = re.sub(r"^data_root: null\n", "", written, flags=re.MULTILINE)
    assert from_text(written, SimulateSettings).data_root == "${oc.env:HOME}"
