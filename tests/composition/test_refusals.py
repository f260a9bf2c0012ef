"""Every key of a simulation refuses a wrong type and a number out of its range, by name, before anything is built."""

from __future__ import annotations

import copy
from collections.abc import Iterator
from dataclasses import fields
from functools import cache
from typing import Any

import pytest

from apcc_torch.composition.run_settings import SimulateSettings
from apcc_torch.errors import ApccError, ConfigError, ValueRangeError
from apcc_torch.reading import plain, read
from apcc_torch.settings import About, Settings, about_of, check_choice, keys
from composed import composed

PARTS = ("pose_filter.delay=1", "integral.gain=1", "plant.transmission.friction=0.1", "arm.tendons.offsets=0.02")
RUNS = {
    "kinematic": ("experiment=kinematic", "dynamics_law=composite", *PARTS),
    "shape": ("experiment=dynamic_run_2", "lookahead=mppi"),
    "affine": ("experiment=robot_2", "adaptation=partial", "model=affine"),
    "strain": ("experiment=tracking", "model=constant_strain"),
}
"""Choices that together have every part there is."""


@cache
def whole(run: str) -> SimulateSettings:
    return composed(*RUNS[run])


def leaves(settings: Settings, path: str = "") -> Iterator[tuple[type[Settings], str, About, str]]:
    """(its class, key, what is known, annotation) of every key that holds no part."""
    for each in keys(type(settings)):
        value = getattr(settings, each.name)
        if isinstance(value, Settings):
            yield from leaves(value, f"{path}{each.name}.")
        elif about_of(each).base is None and "Settings" not in str(each.type):
            yield type(settings), f"{path}{each.name}", about_of(each), str(each.type)


# A key of the same class says the same in every run.
LEAVES = list({(holder, key): (run, key, *leaf) for run in RUNS for holder, key, *leaf in leaves(whole(run))}.values())


def refused(run: str, key: str, value: Any) -> ApccError:
    values = copy.deepcopy(plain(whole(run)))
    *groups, name = key.split(".")
    node = values
    for group in groups:
        node = node[group]
    node[name] = value
    try:
        read(values, SimulateSettings)
    except ApccError as error:
        return error
    pytest.fail(f"{key}={value!r} is taken")


def wrong_types(annotation: str) -> list[Any]:
    kinds = set(annotation.replace(" ", "").split("|"))
    if "Any" in kinds or kinds & {"Strains", "Table"} or annotation.startswith("tuple[tuple"):
        return []  # what they take is told where they are built
    wrong: list[Any] = [{"a": 1}]
    if "str" not in kinds:
        wrong.append("guessed")
    if kinds & {"float", "int", "Setting", "bool", "str"}:
        wrong.append([1])
    if "bool" not in kinds:
        wrong.append(True)
    if "int" in kinds and "float" not in kinds:
        wrong.append(2.5)
    if kinds & {"Lengths", "Numbers"} or annotation.startswith("tuple"):
        wrong.append([1] if annotation.startswith("tuple[str") else ["a"])
    return wrong


def out_of_range(about: About, annotation: str) -> list[Any]:
    wrong = [] if about.above is None else [about.above, about.above - 1]
    wrong += [] if about.least is None else [about.least - 1]
    wrong += [] if about.below is None else [about.below]
    wrong += [] if about.most is None else [about.most + 1]
    numbers = {"float", "int", "Setting", "Numbers", "Lengths"} & set(annotation.replace(" ", "").split("|"))
    if (wrong or numbers) and "int" not in annotation:
        wrong += [float("nan")] if about.infinite else [float("inf"), float("nan")]
    whole_numbers = "int" in annotation and "float" not in annotation
    numbers = [int(value) if whole_numbers else float(value) for value in wrong]
    lists = "Lengths" in annotation or annotation.startswith("tuple")
    return [[value] for value in numbers] if lists else numbers


@pytest.mark.parametrize(("run", "key", "about", "annotation"), LEAVES, ids=[f"{run}:{key}" for run, key, *_ in LEAVES])
def test_wrong_types_and_ranges_are_refused_by_name(run: str, key: str, about: About, annotation: str) -> None:
    for value in wrong_types(annotation):
        said = str(refused(run, key, value))
        assert key in said and "\n" not in said, value
    for value in out_of_range(about, annotation):
        error = refused(run, key, value)
        assert isinstance(error, ValueRangeError) and key in str(error) and about.range in str(error), value
    if about.choices:
        error = refused(run, key, "nonsense")
        assert isinstance(error, ConfigError) and ", ".join(about.choices) in str(error)


def test_every_part_of_the_package_is_among_them() -> None:
    told = {key.partition(".")[0] for _, key, *_ in LEAVES}
    parts = {each.name for each in fields(SimulateSettings) if "Settings" in str(each.type)} | {"arm"}
    assert parts <= told, parts - told
    known = {"plant.pid.K_P", "plant.arm.mass", "adaptation.gamma", "adaptation.time_constant", "dynamics_law.memory"}
    assert known <= {key for _, key, *_ in LEAVES}


def test_choice_lists_the_options() -> None:
    assert check_choice("state", "exact", ("exact", "feedback")) == "exact"
    with pytest.raises(ConfigError, match="state must be one of exact, feedback, got 'both'"):
        check_choice("state", "both", ("exact", "feedback"))


@pytest.mark.parametrize(
    "word",
    [
        *(f"experiment.duration={value}" for value in ("-1", "nan", "inf", "0")),
        *(f"controller.rate={value}" for value in ("0", "-5")),
        *("device=foo", "threads=0", "seed=1e20", "arm.sensors=[0.3,0.9]", "arm.tendon_offset=27"),
    ],
)
def test_what_people_have_typed_is_refused_by_name(word: str) -> None:
    with pytest.raises(ApccError, match=word.partition("=")[0]) as caught:
        composed("experiment=kinematic", word)
    assert "\n" not in str(caught.value)


def test_a_target_out_of_every_reach_is_refused_by_name() -> None:
    with pytest.raises(ApccError, match=r"experiment\.setpoints"):
        composed("experiment=dynamic_run_2", "experiment.setpoints=[[300,0,0]]")
