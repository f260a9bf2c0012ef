"""Units are those that the settings tell."""

from __future__ import annotations

import pytest

from apcc_torch.control.adaptation import AdaptiveLaw
from apcc_torch.report.units import key_label, key_units, metric_label


def test_units_are_the_settings_own() -> None:
    assert key_label("controller.rate") == ("controller.rate", "Hz") and key_label("seed") == ("seed", "")
    assert key_label("plant.pid.K_P").unit == "N/m" and key_label("dynamics_law.payload").unit == "kg"
    # Of a class that is not the group's default too.
    assert AdaptiveLaw.settings_type is not None and key_units()["adaptation.dead_zone"] == "m"
    assert key_label("experiment.nothing") == ("experiment.nothing", "")


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
