"""The points of a batch are the jobs of a multirun, in its order and with its settings."""

from __future__ import annotations

from collections.abc import Sequence

import pytest
from hydra import compose, initialize_config_dir
from hydra._internal.core_plugins.basic_sweeper import BasicSweeper
from hydra.core.override_parser.overrides_parser import OverridesParser
from omegaconf import OmegaConf

from apcc_torch.composition.stacking import Point
from apcc_torch.conf_path import conf_path
from apcc_torch.errors import ApccError, ConfigError
from apcc_torch.sweeps import batch_points as module
from apcc_torch.sweeps.batch_points import batch_points, with_batch
from composed import composed


def points(batch: str | list[str], *overrides: str) -> list[Point]:
    given = ["experiment=kinematic", *overrides]
    with initialize_config_dir(conf_path(), version_base="1.3"):
        cfg = compose("simulate", given)
        OmegaConf.update(cfg, "batch", batch)
        return batch_points(cfg, given, "simulate")


def jobs(*swept: str) -> list[list[str]]:
    """What hydra's own sweeper makes of them."""
    return [
        list(job)
        for job in BasicSweeper.split_arguments(OverridesParser.create().parse_overrides(list(swept)), None)[0]
    ]


@pytest.mark.parametrize(
    "swept",
    [
        ["velocity_filter.window=5,15,45", "adaptation.gain_scale=0.1,0.3,1"],
        ["adaptation.gamma=[9,5,4],[90,42.5,35],7", "velocity_filter.window=range(5,20,5)"],
        ["adaptation=kinematic,partial", "controller.K=1,2", "state=feedback,exact"],
        ["arm=arm_1,arm_2", "bounds.lower=null,[0.1,0.1,0.1]", "seed=shuffle(range(3))", "figures=true,false"],
        ["feedback=position,pose", "feedback.angular_weight=0.1,0.2", "++adaptation.rate=0.1,0.2"],
        [
            "feedback.max_iterations=5,7",
            "arm.placement.rotation=[3.1,0,0],[3,0,0]",
            "integral.gain=1,2",
            "adaptation=none,proof",
        ],
        ["model=pcc,affine", "adaptation=none,shape", "bounds={lower:0.5,upper:2},{upper:1.5}"],
    ],
)
def test_a_point_is_the_job_of_its_number(swept: list[str]) -> None:
    base = ("experiment=kinematic", "controller.rate=50")
    shuffled = any("shuffle" in entry for entry in swept)
    found = points(swept, "controller.rate=50")
    expected = jobs(*swept)
    assert [point.number for point in found] == list(range(len(expected)))
    if shuffled:
        assert {str(point.config) for point in found} == {str(composed(*base, *job)) for job in expected}
        return
    for point, job in zip(found, expected, strict=True):
        assert point.config == composed(*base, *job)
        assert list(point.settings) == [entry.partition("=")[0].lstrip("+") for entry in job]


def test_one_text_is_the_same_as_a_list() -> None:
    text = "adaptation.gamma=[9, 5, 4],[1, 2, 3] velocity_filter.window=5,15"
    assert points(text) == points(["adaptation.gamma=[9,5,4],[1,2,3]", "velocity_filter.window=5,15"])
    assert points(text)[0].settings == {"adaptation.gamma": "[9, 5, 4]", "velocity_filter.window": "5"}


def test_a_fixed_value_among_sweeps_is_one_choice() -> None:
    found = points(["controller.rate=125", "controller.K=1,2"])
    assert [(p.config.controller.rate, p.config.controller.K) for p in found] == [(125.0, 1), (125.0, 2)]


def test_points_of_a_batch_are_no_batches() -> None:
    assert all(point.config.batch is None for point in points(["controller.K=1,2"]))


@pytest.mark.parametrize(
    ("batch", "named"),
    [
        (["controller.gian=1,2"], "controller.gian is no setting"),
        (["gain=1,2"], "gain is no setting"),
        (["controller.K=1,-1", "velocity_filter.window=5,0"], "velocity_filter.window must be"),
        (["adaptation=none,shape", "adaptation.time_constant=1,2"], "adaptation.time_constant is read by nothing"),
        (["controller.rate=fast,slow"], "fast"),
        (["controller.K=interval(1,2)"], "interval"),
        (["hydra.job.name=a,b"], "hydra"),
        (["arm=arm_1,arm_9"], "arm_9"),
        (["controller.K=1,,2"], "batch"),
        ([], "batch"),
        (["velocity_filter.window=5,wide"], "wide"),
    ],
)
def test_what_has_no_meaning_is_named(batch: list[str], named: str) -> None:
    with pytest.raises(ApccError, match=named) as caught:
        points(batch)
    assert all(len(line) < 1000 for line in str(caught.value).splitlines())


def test_too_many_points_are_refused_before_they_are_made(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module, "MOST", 5)
    with pytest.raises(ConfigError, match=r"seed=range\(0,1e12\) has more"):
        points(["seed=range(0,1e12)"])
    with pytest.raises(ConfigError, match="a sweep may have 5 points, got 3 times 2"):
        points(["seed=1,2,3", "controller.K=1,2"])
    assert len(points(["seed=1,2,3,4,5"])) == 5


def test_batch_must_be_texts() -> None:
    with pytest.raises(ConfigError, match="batch must be sweeps"):
        points([5])  # type: ignore[list-item]


def read_back(arguments: Sequence[str]) -> object:
    (override,) = OverridesParser.create().parse_overrides([a for a in arguments if a.startswith("batch=")])
    return override.value()


def test_the_flag_turns_the_sweeps_after_it_into_a_batch() -> None:
    line = [
        "-m",
        "arm=arm_1,arm_2",
        "--batch",
        "experiment=kinematic",
        "controller.K=1,2",
        "seed=range(3)",
        "-cd",
        "x",
    ]
    made = with_batch(line)
    assert made[:-1] == ["-m", "arm=arm_1,arm_2", "experiment=kinematic", "-cd", "x"]
    assert read_back(made) == ["controller.K=1,2", "seed=range(3)"]
    assert with_batch(line[:2]) == line[:2]


def test_a_deletion_goes_with_the_sweep_that_takes_its_place() -> None:
    made = with_batch(["--batch", "experiment=kinematic", "~arm", "~sensors", "arm={lengths:[1]},{lengths:[2]}"])
    assert made[:-1] == ["experiment=kinematic", "~sensors"]
    assert read_back(made) == ["~arm", "arm={lengths:[1]},{lengths:[2]}"]
    first, second = points(["~arm", "arm={lengths:[0.4]},{lengths:[0.2,0.3]}"], "arm=arm_2")
    assert first.config.arm.lengths == (0.4,) and second.config.arm.lengths == (0.2, 0.3)
    assert second.config.arm.sensors is None and list(second.settings) == ["arm"]


@pytest.mark.parametrize(
    "sweep", ["data='a b','c\"d'", 'data="x,y",z', "adaptation.gamma=[1,2,3],[4,5,6]", "data='a\\\\',b"]
)
def test_the_flag_quotes_what_hydra_must_read_back(sweep: str) -> None:
    assert read_back(with_batch(["--batch", sweep])) == [sweep]


@pytest.mark.parametrize("line", [["--batch"], ["controller.K=1,2", "--batch", "controller.K=1"]])
def test_the_flag_needs_a_sweep(line: list[str]) -> None:
    with pytest.raises(ConfigError, match="--batch needs a sweep"):
        with_batch(line)
