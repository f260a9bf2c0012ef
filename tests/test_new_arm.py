"""`new_arm`: what is told becomes an arm's file that every command takes, and what cannot be meant is refused."""

from __future__ import annotations

import sys
from pathlib import Path

import pytest
from matplotlib.image import imread

from apcc_torch import new_arm
from apcc_torch.model.arm import Arm
from apcc_torch.model.material import sag

MINE = ("--lengths", "0.2,0.25", "--offset", "15mm", "--mass", "0.4")


def made(folder: Path, *words: str) -> Arm:
    new_arm.main([str(folder / "mine"), *words])
    return Arm.load(folder / "mine.yaml")


def test_a_file_a_picture_and_what_to_run_next(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    arm = made(tmp_path, *MINE, "--young", "1.2MPa", "--radius", "8mm", "--payload", "50g", "--sensors", "3")
    text = (tmp_path / "mine.yaml").read_text(encoding="utf-8")
    keys = [line for line in text.splitlines() if not line.startswith("#")]
    assert len(keys) <= 12 and all("  # " in key for key in keys)
    assert arm.lengths == (0.2, 0.25) and arm.tendon_offset == 0.015 and arm.mass == 0.4 and arm.payload == 0.05
    assert arm.sensors == (0.15, 0.3, 0.45) and arm.n_tendons == 6 and arm.name == "mine"
    assert arm.bending_rigidity == pytest.approx(1.2e6 * 3.14159 * 0.008**4 / 4, rel=1e-4)
    assert imread(tmp_path / "mine.png").std() > 0.05
    told = capsys.readouterr().out
    assert told.count(f"arm={tmp_path}/mine.yaml\n") == 3 and "mm by itself" in told


def test_without_a_word_on_stiffness_it_sags_by_a_third(tmp_path: Path) -> None:
    arm = made(tmp_path, *MINE)
    rest = sag(arm)
    assert rest is not None and rest.depth == pytest.approx(0.15, rel=1e-3)
    assert "a guess" in (tmp_path / "mine.yaml").read_text(encoding="utf-8")


def test_many_racks_do_not_run_through_each_other(tmp_path: Path) -> None:
    arm = made(tmp_path, "--lengths", "0.1 0.12 0.12 0.13 0.13", "--offset", "0.02", "--mass", "800g", "--young", "1e6",
               "--radius", "0.01")  # fmt: skip
    turned = (arm.routing().angles % (2 * 3.141592653589793)).sort().values
    assert float(turned.diff().min()) > 0.3


@pytest.mark.parametrize(
    ("words", "said"),
    [
        ("--lengths 200,250 --offset 0.015 --mass 0.4", "--lengths is in metres, and 200 reads as mm: give 0.2"),
        ("--lengths 0.2,0.25 --offset 27 --mass 0.4", "--offset is in metres, and 27 reads as mm: give 0.027"),
        ("--lengths 0.2,0.25 --offset 0.027 --mass 400", "--mass is in kilograms, and 400 reads as g: give 0.4"),
        ("--lengths 0.2 --offset 9mm --mass 1 --young 1.2 --radius 8mm", "in pascals, and 1.2 reads as MPa: give"),
        ("--lengths 0.2 --offset 9mm", "--mass must be given: mass of the whole arm"),
        ("--lengths 0.2 --offset 9mm --mass 1,2", "--mass must be one number, or 1, one a section, got 2"),
        ("--lengths 0.2 --offset 0.15 --mass 1", "--offset must be less than half the shortest section, 0.1 m"),
        ("--lengths 0.2,-1 --offset 9mm --mass 1", "--lengths must be positive, got -1"),
        ("--lengths 0.2 --offset 9bar --mass 1", "--offset has the unit 'bar', and can have m, mm, cm, um"),
        ("--lengths 0.2 --offset x --mass 1", "--offset must be a number in metres, such as 0.05, got 'x'"),
        ("--lengths 0.2 --offset 9mm --mass 1 --radius 8mm", "--radius is read by nothing without --young"),
        ("--lengths 0.2 --offset 9mm --mass 1 --young 1MPa", "--radius must be given: radius of the backbone"),
        ("--lengths 0.2 --offset 9mm --mass 1 --young 1MPa --radius 8mm --sag 0.1", "give --young or --sag, not both"),
        ("--lengths 0.2 --offset 9mm --mass 1 --layout copled", "--layout must be one of coupled, independent"),
        ("--lengths 0.2 --offset 9mm --mass 1 --sensors 0.3", "sensors must lie on the arm, 0.2 m long"),
        ("--lenghts 0.2", "there is no argument --lenghts; did you mean --lengths?"),
    ],
)
def test_what_cannot_be_meant_is_refused(
    words: str, said: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(SystemExit) as ended:
        new_arm.main([str(tmp_path / "mine"), *words.split()])
    told = capsys.readouterr().err
    assert ended.value.code == 2 and said in told and len(told.splitlines()) == 1, told
    assert not list(tmp_path.iterdir())


def test_a_file_that_is_there_is_written_over_where_that_is_said(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "mine.png").write_text("mine")
    stiff = ("--young", "1MPa", "--radius", "9mm")
    with pytest.raises(SystemExit):
        made(tmp_path, *MINE, *stiff)
    assert "mine.png is there already" in capsys.readouterr().err and not (tmp_path / "mine.yaml").exists()
    made(tmp_path, *MINE, *stiff, "overwrite=true")
    assert (tmp_path / "mine.png").read_bytes()[:4] == b"\x89PNG"


def test_on_a_terminal_it_asks_for_what_is_missing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    said = iter(["200,250", "0.2,0.25", "0.015", "", "0.4", "4", "", "", "", "1MPa", "", "9mm", "", ""])
    asked: list[str] = []
    monkeypatch.setattr(sys.stdin, "isatty", lambda: True, raising=False)
    monkeypatch.setattr("builtins.input", lambda text: (asked.append(text), next(said))[1])
    arm = made(tmp_path)
    assert arm.tendons_per_rack == 4 and arm.bending_rigidity == pytest.approx(1e6 * 3.14159 * 0.009**4 / 4, rel=1e-4)
    assert "200 reads as mm" in capsys.readouterr().out
    assert not any("hangs below" in text for text in asked) and next(said, None) is None


def test_help_teaches(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as ended:
        new_arm.main(["--help"])
    told = capsys.readouterr().out
    assert ended.value.code == 0 and "examples:" in told and "--young VALUE" in told and "[kg]" in told
