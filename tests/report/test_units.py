"""Units are those of keys that exist."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator

import pytest

from apcc_torch.composition.schema import SimulateConfig
from apcc_torch.report.units import KEY_UNITS, key_label, metric_label


def keys(instance: object, prefix: str = "") -> Iterator[str]:
    for field in dataclasses.fields(instance):  # type: ignore[arg-type]
        value = getattr(instance, field.name)
        if dataclasses.is_dataclass(value):
            yield from keys(value, f"{prefix}{field.name}.")
        else:
            yield prefix + field.name


def test_every_key_with_a_unit_is_a_setting() -> None:
    assert set(KEY_UNITS) <= set(keys(SimulateConfig()))
    assert key_label("controller.rate") == ("controller.rate", "Hz") and key_label("seed") == ("seed", "")


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
