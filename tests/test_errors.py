"""Checks are all made before anything is raised, and each sentence says where it belongs."""

from __future__ import annotations

import pickle
from pathlib import Path

import pytest

from apcc_torch.composition.run_settings import SimulateSettings
from apcc_torch.composition.schema import check_words
from apcc_torch.errors import Checks, ConfigError, MismatchError, ValueRangeError, begun_with
from apcc_torch.model.arm import Arm
from composed import changed


def test_one_error_stays_what_it_is_and_several_become_one() -> None:
    checks = Checks()
    checks.end()
    with checks.one():
        raise ValueRangeError("a")
    with pytest.raises(ValueRangeError, match=r"^a$"):
        checks.end()
    for text in ("a", "b"):  # a sentence that was told is told once
        with checks.one():
            raise ConfigError(text)
    with pytest.raises(MismatchError, match=r"^a\nb$") as several:
        checks.end()
    assert str(begun_with("x.", several.value)) == "x.a\nx.b"
    assert str(pickle.loads(pickle.dumps(several.value))) == "a\nb"


def test_all_that_does_not_fit_of_an_arms_file_is_told_at_once(tmp_path: Path) -> None:
    file = tmp_path / "mine.yaml"
    file.write_text(
        "lengths: [0.2, 0.25]\nsensors: [0.2, 0.5]\nmasses: [0.1, 0.2, 0.3]\n"
        "bending_rigidity: [1, 2, 3]\ntendon_offset: 0.7\nrest_bend: [[0.1, 0.2, 0.3]]\n"
    )
    with pytest.raises(MismatchError) as refused:
        Arm.load(file)
    told = str(refused.value).splitlines()
    assert all(line.startswith(f"{file}: ") for line in told)
    named = [line.removeprefix(f"{file}: ").split()[0] for line in told]
    assert named == ["sensors", "masses", "bending_rigidity", "tendon_offset", "rest_bend"]


def test_wrong_keys_types_and_ranges_are_told_at_once(tmp_path: Path) -> None:
    file = tmp_path / "mine.yaml"
    file.write_text("lenghts: [0.2]\nlengths: [0.2]\nmas: 3\ntendon_offset: big\npayload: -1\n")
    with pytest.raises(MismatchError) as refused:
        Arm.load(file)
    told = [line.removeprefix(f"{file}: ") for line in str(refused.value).splitlines()]
    assert told == [
        "lenghts is no setting; did you mean lengths?",
        "mas is no setting; did you mean mass?",
        "tendon_offset must be a number, got 'big'",
        "payload must be zero or positive and finite, got -1.0",
    ]


def test_all_that_does_not_fit_of_a_command_line_is_told_at_once() -> None:
    with pytest.raises(MismatchError, match=r"controler is no setting; .*\nsead is no setting; "):
        check_words(["controler.K=1", "seed=3", "sead=2"], SimulateSettings, "simulate")
    with pytest.raises(MismatchError) as refused:
        changed("dynamic_run_2", "arm.sensors=[0.9]", "controller.K=abc", "threads=no", "plant.refine=0")
    named = [line.split()[0] for line in str(refused.value).splitlines()]
    assert sorted(named) == ["arm.sensors", "controller.K", "plant.refine", "threads"]
