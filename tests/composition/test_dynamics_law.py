"""`dynamics_law` becomes the controller it describes; every refusal names its key."""

from __future__ import annotations

import pytest
import torch

from apcc_torch.composition.build import Builder
from apcc_torch.composition.dynamics_law import true_parameters, with_dynamics
from apcc_torch.control.composite_controller import CompositeController, CompositeControllerSettings
from apcc_torch.errors import ApccError, ConfigError
from apcc_torch.model.dynamics_regressor import PARAMETERS
from composed import changed, composed

COMPOSITE = "dynamic_run_2_composite"


def made(*changes: str, experiment: str = COMPOSITE) -> CompositeController:
    build = Builder(changed(experiment, *changes))
    controller = with_dynamics(build, build.controller())
    assert isinstance(controller, CompositeController)
    return controller


def test_without_a_law_the_controller_is_handed_back() -> None:
    build = Builder(changed("dynamic_run_2"))
    plain = build.controller()
    assert changed("dynamic_run_2").dynamics_law is None and with_dynamics(build, plain) is plain


@pytest.mark.parametrize(("choice", "adapts"), [("feedforward", False), ("composite", True)])
def test_a_choice_says_whether_it_adapts_and_nothing_else(choice: str, adapts: bool) -> None:
    chosen = composed("experiment=dynamic_run_2", f"dynamics_law={choice}").dynamics_law
    assert chosen == CompositeController.settings_type(adapts=adapts)
    assert isinstance(chosen, CompositeControllerSettings)


def test_the_law_takes_its_settings() -> None:
    values = {
        "payload": 0.1, "mass_deviation": 0.2, "memory": 3, "upper": "[1,99,999,0.6,2]", "stiffness": 0.5,
        "force_limit": 60, "damping_ratio": 0.2, "tracking_gain": 2, "prediction": "false",
    }  # fmt: skip
    c = made(*(f"dynamics_law.{name}={value}" for name, value in values.items()))
    assert c.law.nominal.tolist() == [0.0778, 10.0, 200.0, 0.1, 1.0]
    assert c.law.deviation.tolist() == [0.02, 3.0, 50.0, 0.3, 0.2] and c.law.upper.tolist() == [1, 99, 999, 0.6, 2]
    assert (c.law.memory, c.law.tracking_gain, c.law.prediction) == (3.0, 2.0, False)
    assert (c.stiffness, c.force_limit, c.dynamics.damping_ratio) == (0.5, 60.0, 0.2)
    assert c.kinematic.adaptive and not c.kinematic.laws, "the experiment keeps its rest lengths"


def test_a_feed_forward_moves_nothing() -> None:
    c = made("dynamics_law.adapts=false")
    assert c.law.deviation.tolist() == [0.0] * 5 and not c.law.prediction and c.law.tracking_gain == 0.0


def test_what_the_plant_is() -> None:
    payload = torch.tensor([0.0, 0.5], dtype=torch.float64)
    true = true_parameters(
        Builder(changed(COMPOSITE, "plant.arm.bending_stiffness=0.5", "arm.mass=1.2", "plant.tendon_damping=200")),
        payload,
    )
    want = torch.tensor([[0.05, 10.0, 200.0, 0.0, 1.2], [0.05, 10.0, 200.0, 0.5, 1.2]], dtype=torch.float64)
    torch.testing.assert_close(true, want)
    literal = true_parameters(Builder(changed(COMPOSITE, "arm.stiffness_rule=proportional")), payload)
    assert bool(literal[:, :2].isnan().all()) and literal[:, PARAMETERS.index("payload")].tolist() == [0.0, 0.5]


@pytest.mark.parametrize(
    ("change", "named"),
    [
        ("dynamics_law.kind=both", "dynamics_law.kind"),
        ("dynamics_law.kind=apcc_torch.simulation.plant.Plant", "must be a CompositeController"),
        ("dynamics_law.payload_deviation=-1", "dynamics_law.payload_deviation"),
        ("dynamics_law.payload=-1", "dynamics_law.payload"),
        ("dynamics_law.memory=0", "dynamics_law.memory"),
        ("dynamics_law.stiffness=-1", "dynamics_law.stiffness"),
        ("dynamics_law.upper=[1,2]", "upper"),
    ],
)
def test_a_setting_without_meaning_is_named(change: str, named: str) -> None:
    with pytest.raises(ApccError, match=named):
        made(change)


def test_other_models_are_refused() -> None:
    build = Builder(composed(f"experiment={COMPOSITE}", "model=constant_strain"))
    with pytest.raises(ConfigError, match="model=pcc"):
        with_dynamics(build, build.controller())
