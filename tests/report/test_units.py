"""Units are those of the settings."""

from __future__ import annotations

import pytest

from apcc_torch.composition.help import rows
from apcc_torch.reading import plain
from apcc_torch.report.settings import flatten
from apcc_torch.report.units import key_label, metric_label
from composed import composed


@pytest.mark.parametrize("experiment", ["kinematic", "dynamic_run_2_bank", "dynamic_run_2_composite"])
def test_every_key_of_a_run_has_the_unit_of_its_setting(experiment: str) -> None:
    config = composed(f"experiment={experiment}")
    run = flatten(plain(config))
    units = {row.key: row.unit.replace("^2", "²") for row in rows(config)}
    assert {key: key_label(key, [{}, run]).unit for key in units} == units
    assert units["arm.lengths"] == "m" and units["controller.rate"] == "Hz" and units["seed"] == ""


def test_a_key_of_a_class_that_is_not_there_has_no_unit() -> None:
    assert key_label("adaptation.dead_zone") == ("adaptation.dead_zone", "")
    assert key_label("adaptation.dead_zone", [{"adaptation.kind": "somewhere.Law"}]).unit == ""
    assert key_label(
        "adaptation.dead_zone", [{}, {"adaptation.kind": "apcc_torch.control.adaptation.AdaptiveLaw"}]
    ) == (
        "adaptation.dead_zone",
        "m",
    )
    assert key_label("robot.mass").unit == key_label("seed.more").unit == ""


@pytest.mark.parametrize(
    ("name", "label"),
    [
        ("shape_error_mean_mm", ("shape error mean", "mm")),
        ("sensor_error_angular_mean_rad", ("sensor error angular mean", "rad")),
        ("wall_s", ("wall", "s")),
        ("settled_share", ("settled share", "")),
        ("rows", ("rows", "")),
        ("m", ("m", "")),
    ],
)
def test_metrics_carry_their_unit_in_their_name(name: str, label: tuple[str, str]) -> None:
    assert metric_label(name) == label
