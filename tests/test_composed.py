"""`compose` in Python is the command line in Python: the same words, the same settings, the same numbers."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest
import torch
import yaml
from hydra import initialize_config_dir

import apcc_torch
from apcc_torch import APCCController, Arm, compose
from apcc_torch.composition.run_settings import SimulateSettings
from apcc_torch.conf_path import conf_path
from apcc_torch.control.composite_controller import CompositeController
from apcc_torch.control.step_io import Measurement, Target
from apcc_torch.errors import ApccError, DataError
from apcc_torch.reading import read
from commands import ROOT
from composed import composed

QUICK = ("experiment.duration=0.1", "controller.rate=50", "figures=false", "progress=false")


@pytest.mark.parametrize(
    "words",
    [
        ("experiment=dynamic_run_2", "controller.K=1.2"),
        ("experiment=kinematic", "adaptation=none", "integral.gain=0.5"),
    ],
)
def test_the_settings_are_those_of_the_command_line(words: tuple[str, ...]) -> None:
    assert compose(*words).settings == composed(*words)


def test_it_prints_as_the_file_that_a_run_leaves() -> None:
    one = compose("experiment=tracking")
    assert read(yaml.safe_load(str(one)), SimulateSettings) == one.settings


def test_the_controller_and_the_plant_are_those_of_the_run() -> None:
    one = compose("experiment=dynamic_run_2", "experiment.payloads=[0.0,0.5]")
    controller, plant, pi = one.controller(), one.plant(), one.first_estimate()
    assert isinstance(controller, APCCController) and pi.tolist() == [0.105, 0.255, 0.24]
    assert plant.payload.tolist() == [0.0, 0.5] * 10
    state = controller.initial_state(torch.zeros(9).double(), pi)
    T = controller.feedback.backbone.pose(state.q_bar, pi, *apcc_torch.decouple(controller.feedback.abscissae, pi))
    x = torch.tensor([0.1, 0.0, -0.55]).double()
    state, command = controller(state, Measurement(T, torch.tensor(0.01).double()), Target(x, torch.zeros_like(x)))
    assert command.y is not None and command.y.shape == (9,)
    assert compose("experiment=tracking").plant().payload.tolist() == [0.0, 0.25, 0.5]
    assert isinstance(compose("experiment=dynamic_run_2_composite").controller(), CompositeController)


def test_a_run_is_the_commands(tmp_path: Path) -> None:
    one = compose("experiment=kinematic", *QUICK)
    metrics = one.run(tmp_path / "new" / "run")
    assert json.loads((tmp_path / "new" / "run" / "metrics.json").read_text()) == metrics
    values = yaml.safe_load((tmp_path / "new" / "run" / "config.yaml").read_text())
    assert read(values, SimulateSettings) == one.settings


def test_an_arm_of_a_file(tmp_path: Path) -> None:
    Arm(name="mine", lengths=(0.2, 0.25), mass=0.4).save(tmp_path / "mine.yaml")
    one = compose("experiment=kinematic", f"arm={tmp_path / 'mine.yaml'}", "arm.sensors=[0.25,0.45]")
    assert (one.settings.arm.lengths, one.settings.arm.mass, one.settings.arm.name) == ((0.2, 0.25), 0.4, "mine")
    assert one.settings.arm.sensors == (0.25, 0.45)
    with pytest.raises(DataError, match=r"none\.yaml"):
        compose("experiment=kinematic", f"arm={tmp_path / 'none.yaml'}")


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (("experiment=kinematics",), r"experiment has no choice 'kinematics'; did you mean kinematic\?"),
        (("experiment=kinematic", "adaptation=normal"), "adaptation has no choice 'normal'; did you mean normalised"),
        (("experimnt=kinematic",), "experimnt is no setting; did you mean experiment?"),
        (("experiment=kinematic", "controller.null_gian=1"), "null_gian is no setting; did you mean null_gain?"),
        (("experiment=kinematic", "adaptation=none", "adaptation.gamma=3"), "adaptation.gamma is read by nothing"),
        (("experiment=kinematic", "controller.K=-1"), "K"),
        (("experiment=kinematic", "controller.K=[1,"), "mismatched input|no viable|LexerNoViable|Error parsing"),
        ((), "experiment"),
    ],
)
def test_what_has_no_meaning_is_refused_in_one_sentence(words: tuple[str, ...], said: str) -> None:
    with pytest.raises(ApccError, match=said) as caught:
        compose(*words).controller()
    assert "\n" not in str(caught.value)


def test_it_goes_along_with_a_hydra_that_is_initialised() -> None:
    with initialize_config_dir(conf_path(), version_base="1.3"):
        assert compose("experiment=kinematic").settings == composed_outside()


def composed_outside() -> SimulateSettings:
    """As `composed`, within an initialised hydra."""
    return compose("experiment=kinematic", "seed=0").settings


def test_the_package_is_light_until_compose_is_asked_for() -> None:
    code = (
        "import sys; from apcc_torch import Arm, APCCController; import apcc_torch as a;"
        "print([name in sys.modules for name in ('hydra', 'matplotlib', 'apcc_torch.composition')]);"
        "a.compose; print('hydra' in sys.modules)"
    )
    env = os.environ | {"PYTHONPATH": str(ROOT)}
    done = subprocess.run([sys.executable, "-c", code], env=env, capture_output=True, text=True, check=True)
    assert done.stdout.splitlines() == ["[False, False, False]", "True"]
    with pytest.raises(AttributeError, match="has no attribute 'composes'"):
        apcc_torch.composes  # noqa: B018
