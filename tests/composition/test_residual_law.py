"""`residual` becomes the law it describes, around the controller's own algorithm 2; every refusal names its key."""

from __future__ import annotations

import inspect
from pathlib import Path

import pytest
from omegaconf import OmegaConf

from apcc_torch.composition.build import Builder
from apcc_torch.conf_path import conf_path
from apcc_torch.control.length_bank import LengthBank
from apcc_torch.control.residual_adaptation import ResidualLaw
from apcc_torch.errors import ApccError, ConfigError
from composed import changed

NUMBERS = {
    "time_constant": 0.7, "elongation_weight": 0.11, "nominal_weight": 0.12, "total_weight": 0.13, "damping": 0.14,
    "excitation": 0.15, "memory": 0.16, "rate": 0.17, "sharpness": 0.18, "resolution": 0.19,
}  # fmt: skip


def made(*changes: str) -> ResidualLaw | LengthBank | None:
    return Builder(changed("dynamic_run_2", *changes)).controller().residual_law


def numbers(law: ResidualLaw | LengthBank | None) -> dict[str, float]:
    return {name: getattr(law, name) for name in NUMBERS if hasattr(law, name)}


def test_without_a_target_there_is_none() -> None:
    assert made("residual.target=null") is None


@pytest.mark.parametrize("target", ["curve", "sensors", "bank"])
def test_the_law_takes_its_settings(target: str) -> None:
    law = made(
        f"residual.target={target}",
        *(f"residual.{name}={value}" for name, value in NUMBERS.items()),
        "residual.angular_weight=0.2",
        "residual.gains=[1,2,3]",
        "residual.shares=[0.5,1]",
        "robot.initial_estimate=[0.1,0.2,0.3]",
    )
    assert law is not None and law.nominal.tolist() == [0.1, 0.2, 0.3]
    if isinstance(law, LengthBank):
        missing = {"total_weight", "damping", "excitation"}
        assert target == "bank" and sorted(law.candidates[:, 0].tolist()) == [0.05, 0.05, 0.1, 0.1]
    else:
        missing = {"sharpness", "resolution"}
        assert law.target == target and law.gains.tolist() == [1, 2, 3] and law.angular_weight == 0.2
        assert (law.curve is None) == (target == "sensors")
    assert numbers(law) == {name: value for name, value in NUMBERS.items() if name not in missing}


@pytest.mark.parametrize("target", ["curve", "bank"])
@pytest.mark.parametrize(
    ("mode", "asked", "tangents"),
    [
        ("position", "null", "spline"),
        ("pose", "null", "measured"),
        ("hierarchical", "null", "measured"),
        ("pose", "spline", "spline"),
    ],
)
def test_the_curve_goes_through_the_sensors_that_algorithm_2_has(
    target: str, mode: str, asked: str, tangents: str
) -> None:
    changes = (f"feedback.mode={mode}", f"residual.target={target}", f"residual.tangents={asked}", "residual.samples=3")
    controller = Builder(changed("dynamic_run_2", *changes, "robot.sensors=[0.2,0.4,0.6]")).controller()
    law = controller.residual_law
    assert law is not None and law.curve is not None and law.curve.tangents == tangents
    assert not isinstance(law, LengthBank) or law.feedback is controller.feedback
    for sensor in (0.2, 0.4, 0.6):  # the curve's points are those of the sensors and those between
        assert min(abs(float(X) - sensor) for X in law.curve.abscissae) < 1e-12


def test_a_bank_of_its_own_is_the_one_of_the_settings() -> None:
    settings = OmegaConf.load(Path(conf_path()) / "residual" / "bank.yaml")
    defaults = {
        name: parameter.default
        for name, parameter in inspect.signature(LengthBank).parameters.items()
        if parameter.default is not parameter.empty
    }
    assert defaults == {name: settings[name] for name in defaults} | {"shares": tuple(settings.shares)}


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ("residual.target=all", "residual.target must be one of curve, sensors, bank, got 'all'"),
        ("residual.gains=[1,2]", "residual.gains must have 3 entries, got 2"),
    ],
)
def test_a_setting_without_meaning_is_named(change: str, said: str) -> None:
    with pytest.raises(ConfigError, match=said):
        made(change)


@pytest.mark.parametrize("change", ["rate=0", "memory=-1", "tangents=guessed"])
def test_a_refusal_from_below_names_the_setting(change: str) -> None:
    with pytest.raises(ApccError, match=change.partition("=")[0]):
        made("residual.target=curve", f"residual.{change}")
