"""`residual` becomes the law it describes, around the controller's own algorithm 2; every refusal names its key."""

from __future__ import annotations

import pytest

from apcc_torch.composition.build import Builder
from apcc_torch.control.length_bank import LengthBank
from apcc_torch.control.length_law import LengthLaw
from apcc_torch.control.residual_adaptation import ResidualLaw
from apcc_torch.errors import ApccError, ConfigError
from composed import changed, composed

NUMBERS = {
    "time_constant": 0.7, "elongation_weight": 0.11, "nominal_weight": 0.12, "total_weight": 0.13, "damping": 0.14,
    "excitation": 0.15, "memory": 0.16, "rate": 0.17, "sharpness": 0.18, "resolution": 0.19,
}  # fmt: skip
MISSING = {
    "bank": {"total_weight", "damping", "excitation"},
    "curve": {"sharpness", "resolution"},
    "joint": {"sharpness", "resolution"},
}
"""What is no setting of a choice."""


def made(*changes: str, residual: str = "curve") -> LengthLaw:
    controller = Builder(composed("experiment=dynamic_run_2", f"residual={residual}", *changes)).controller()
    (law,) = controller.laws
    return law


def test_without_a_choice_there_is_none() -> None:
    config = composed("experiment=dynamic_run_2", "residual=none")
    assert config.residual is None and len(Builder(config).controller().laws) == 0


@pytest.mark.parametrize("choice", sorted(MISSING))
def test_the_law_takes_its_settings(choice: str) -> None:
    own = {name: value for name, value in NUMBERS.items() if name not in MISSING[choice]}
    changes = [f"residual.{name}={value}" for name, value in own.items()]
    changes += ["residual.shares=[0.5,1]"] if choice == "bank" else ["residual.gains=[1,2,3]"]
    changes += ["residual.angular_weight=0.2"] if choice == "joint" else []
    law = made(*changes, "arm.lengths=[0.1,0.2,0.3]", "experiment.first_estimate=[1,1,1]", residual=choice)
    assert {name: getattr(law, name) for name in own} == own
    if choice == "bank":
        assert isinstance(law, LengthBank) and law.nominal.tolist() == pytest.approx([0.1, 0.2, 0.3])
        assert sorted(law.candidates[:, 0].tolist()) == [0.05, 0.05, 0.1, 0.1]
    else:
        assert isinstance(law, ResidualLaw) and law.nominal.tolist() == pytest.approx([0.1, 0.2, 0.3])
        assert law.gains is not None and law.gains.tolist() == [1, 2, 3]
        assert (law.target, law.curve is None) == (("sensors", True) if choice == "joint" else ("curve", False))
        assert choice != "joint" or law.angular_weight == 0.2


@pytest.mark.parametrize("choice", sorted(MISSING))
def test_what_is_no_setting_of_the_choice_is_refused(choice: str) -> None:
    for name in MISSING[choice]:
        with pytest.raises(ConfigError, match=f"residual.{name} is no setting"):
            composed("experiment=dynamic_run_2", f"residual={choice}", f"residual.{name}=1")


@pytest.mark.parametrize("choice", ["curve", "bank"])
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
    choice: str, mode: str, asked: str, tangents: str
) -> None:
    kind = {"curve": "residual_adaptation.ResidualLaw", "bank": "length_bank.LengthBank"}[choice]
    config = changed(
        "dynamic_run_1",
        f"feedback.mode={mode}",
        f"residual={{kind: apcc_torch.control.{kind}, samples: 3, tangents: {asked}}}",
        "arm.sensors=[0.2,0.4,0.6]",
    )
    controller = Builder(config).controller()
    (law,) = controller.laws
    assert isinstance(law, ResidualLaw | LengthBank) and law.curve is not None and law.curve.tangents == tangents
    assert not isinstance(law, LengthBank) or law.feedback is controller.feedback
    for sensor in (0.2, 0.4, 0.6):  # the curve's points are those of the sensors and those between
        assert min(abs(float(X) - sensor) for X in law.curve.abscissae) < 1e-12


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ("residual.target=all", "residual.target must be one of curve, sensors, got 'all'"),
        ("residual.gains=[1,2]", "gains must have 3 entries, got 2"),
        ("residual.rate=0", r"residual.rate must be positive and finite, got 0\.0"),
        ("residual.memory=-1", "residual.memory must be zero or positive and finite"),
        ("residual.tangents=guessed", "residual.tangents must be one of"),
    ],
)
def test_a_setting_without_meaning_is_named(change: str, said: str) -> None:
    with pytest.raises(ApccError, match=said):
        made(change)
