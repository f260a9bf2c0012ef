"""TAB completes choices, keys, and the values of a few words, of what the words before it mean."""

from __future__ import annotations

from pathlib import Path

import pytest

from apcc_torch import robot, simulate
from apcc_torch.completion import answered, completions

PROGRAMS = {"simulate": simulate, "robot": robot}


@pytest.mark.parametrize(
    ("line", "expected"),
    [
        ("apcc-simulate experiment=kin", ["experiment=kinematic"]),
        ("apcc-simulate experiment=kinematic controller.null_g", ["controller.null_gain="]),
        ("apcc-simulate experiment=kinematic cont", ["controller."]),
        ("apcc-simulate experiment=kinematic pla", ["plant="]),
        ("apcc-simulate experiment=dynamic_run_2 plant.ev", ["plant.events."]),
        ("apcc-simulate dtype=", ["dtype=float32", "dtype=float64"]),
        ("apcc-simulate experiment=dynamic_run_2 controller.K=", ["controller.K=1.8"]),
        ("apcc-simulate controller.adaptive=t", ["controller.adaptive=true"]),
        ("apcc-simulate --mu", ["--multirun"]),
        ("apcc-simulate experiment=nonsense controller.ad", ["controller.adaptive="]),
        ("apcc-robot experiment=setpoint guards.arr", ["guards.arrival_dwell=", "guards.arrival_error="]),
        ("apcc-robot experiment=kin", []),
    ],
)
def test_completes(line: str, expected: list[str]) -> None:
    assert completions(line.split()[0].removeprefix("apcc-"), line) == expected


def test_an_arms_files_are_choices_too(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "arm_of_mine.yaml").write_text("lengths: [0.2, 0.3]\n")
    (tmp_path / "arm_picture.png").write_text("")
    assert completions("simulate", "apcc-simulate arm=arm_") == ["arm=arm_1", "arm=arm_2", "arm=arm_of_mine.yaml"]
    keys = completions("simulate", "apcc-simulate arm=arm_of_mine.yaml experiment=kinematic seed")
    assert keys == ["seed="]


@pytest.mark.parametrize("module", PROGRAMS.values(), ids=list(PROGRAMS))
def test_every_listed_experiment_completes_to_keys(module: object) -> None:
    command = next(name for name, each in PROGRAMS.items() if each is module)
    for experiment in module.EXPERIMENTS:  # type: ignore[attr-defined]
        assert completions(command, f"apcc-{command} experiment={experiment} seed") == ["seed="]


def test_answers_a_shell_alone(capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> None:
    assert not answered("simulate", ["experiment=kinematic"])
    assert not answered("simulate", ["-sc", "install=bash"])
    monkeypatch.setenv("COMP_LINE", "apcc-simulate dtype=")
    assert answered("simulate", ["-sc", "query=bash"]) and answered("simulate", ["-sc", "query=fish"])
    assert capsys.readouterr().out == "dtype=float32 dtype=float64\ndtype=float32\ndtype=float64\n"
