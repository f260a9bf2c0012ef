"""Every configuration fits the schema; a key or type that does not is refused with its name."""

from __future__ import annotations

import dataclasses
import importlib
import re
import warnings
from pathlib import Path

import pytest
from hydra import compose, initialize_config_dir
from hydra.errors import HydraException
from omegaconf import OmegaConf

from apcc_torch.composition.schema import (
    AdaptationConfig,
    ControllerConfig,
    FeedbackConfig,
    ModelConfig,
    PlantConfig,
    RobotConfig,
    SensorsConfig,
    SimulateConfig,
    VelocityFilterConfig,
)
from apcc_torch.conf_path import conf_path
from apcc_torch.errors import ConfigError
from apcc_torch.experiments.run import EXPERIMENTS
from apcc_torch.sweeps.callback import planned
from composed import ON_AN_ARM, composed, raw

CONF = Path(conf_path())
GROUPS = {
    "adaptation": AdaptationConfig,
    "controller": ControllerConfig,
    "feedback": FeedbackConfig,
    "model": ModelConfig,
    "plant": PlantConfig,
    "robot": RobotConfig,
    "sensors": SensorsConfig,
    "velocity_filter": VelocityFilterConfig,
}


def choices(group: str) -> list[str]:
    return sorted(path.stem for path in (CONF / group).glob("*.yaml"))


@pytest.mark.parametrize("experiment", sorted(set(choices("experiment")) - ON_AN_ARM))
def test_every_experiment_composes(experiment: str) -> None:
    config = composed(f"experiment={experiment}")
    assert isinstance(config, SimulateConfig)
    assert config.experiment.name == experiment
    assert config.experiment.kind in EXPERIMENTS
    assert OmegaConf.missing_keys(raw(f"experiment={experiment}")) == set()


@pytest.mark.parametrize("experiment", ["kinematic", "dynamic_run_2", "replay"])
def test_every_choice_composes_with_every_kind_of_experiment(experiment: str) -> None:
    available = {group: choices(group) for group in GROUPS}
    for k in range(max(len(names) for names in available.values())):
        chosen = {group: names[k % len(names)] for group, names in available.items()}
        config = composed(f"experiment={experiment}", *(f"{group}={name}" for group, name in chosen.items()))
        assert all(isinstance(getattr(config, group), kind) for group, kind in GROUPS.items())
        assert config.experiment.name == experiment


@pytest.mark.parametrize("state", ["feedback", "exact"])
def test_both_states_compose(state: str) -> None:
    assert composed("experiment=kinematic", f"state={state}").state == state


@pytest.mark.parametrize("sweep", choices("sweep"))
def test_every_sweep_composes_and_sweeps_keys_that_there_are(sweep: str) -> None:
    if "optuna" in sweep:
        pytest.importorskip("hydra_plugins.hydra_optuna_sweeper")
    with initialize_config_dir(str(CONF), version_base="1.3"):
        config = compose("simulate", ["experiment=dynamic_run_2", f"sweep={sweep}"], return_hydra_config=True)
    assert config.hydra.mode.name == "MULTIRUN"
    plan = planned(config)
    assert plan.keys == set(config.hydra.sweeper.params) and plan.total > 1
    for key in config.hydra.sweeper.params:
        assert OmegaConf.select(config, key, throw_on_missing=True) is not None, key


PLUGINS = {
    "joblib": "joblib",
    "submitit_local": "submitit",
    "submitit_slurm": "submitit",
    "ray_local": "ray",
    "ray_cluster": "ray",
}


@pytest.mark.parametrize("launcher", choices("hydra/launcher"))
def test_every_launcher_composes_and_is_there_to_be_made(launcher: str) -> None:
    pytest.importorskip(f"hydra_plugins.hydra_{PLUGINS[launcher]}_launcher")
    with initialize_config_dir(str(CONF), version_base="1.3"), warnings.catch_warnings():
        warnings.filterwarnings("ignore", message=r"\s*'hydra/launcher/\w+' is validated against ConfigStore schema")
        asked = ["experiment=kinematic", f"hydra/launcher={launcher}", "hydra.sweep.dir=/s"]
        config = compose("simulate", asked, return_hydra_config=True)
    module, _, name = config.hydra.launcher._target_.rpartition(".")
    assert isinstance(getattr(importlib.import_module(module), name), type)


DOCUMENTED = (*sorted(GROUPS), "experiment", "state", "sweep", "hydra/launcher")
NAMES = {"_target_", "kind", "mode", "name", "objective", "state", "subset"}
"""What says itself, or is what the head of its file says."""


@pytest.mark.parametrize("group", DOCUMENTED)
def test_every_value_says_what_it_is(group: str) -> None:
    for path in sorted((CONF / group).glob("*.yaml")):
        lines = path.read_text(encoding="utf-8").splitlines()
        assert any(line.startswith("#") and "@package" not in line for line in lines), f"{path}: what is it?"
        values = [(line, re.match(r"\s*([\w.]+): +[^\s#]", line)) for line in lines]
        silent = [line for line, found in values if found and found[1] not in NAMES and "#" not in line]
        assert not silent, f"{path.relative_to(CONF)}: {silent}"


@pytest.mark.parametrize("group", sorted(GROUPS))
def test_every_choice_sets_every_key_of_its_group(group: str) -> None:
    # A key that a file leaves out would take its value, unseen, from the schema.
    keys = {field.name for field in dataclasses.fields(GROUPS[group])}
    for name in choices(group):
        assert set(OmegaConf.load(CONF / group / f"{name}.yaml")) == keys, f"conf/{group}/{name}.yaml"


def test_the_papers_numbers() -> None:
    config = composed("experiment=dynamic_run_2")
    assert config.plant.lengths == [0.0525, 0.0525, 0.1275, 0.1275, 0.12, 0.12]
    assert (config.plant.K_P, config.plant.K_I, config.plant.K_D) == (750.0, 1.0, 5.0)
    assert (config.plant.axial_stiffness, config.plant.bending_stiffness) == (100.0, 0.778)
    assert config.robot.sensors == config.robot.racks == [0.105, 0.36, 0.60]
    assert config.experiment.payloads == [0.0, 0.25, 0.5]
    assert config.experiment.setpoints is not None and len(config.experiment.setpoints) == 10
    assert config.experiment.setpoints[0] == [0.325, 0.15, -0.275]
    sine = composed("experiment=kinematic").experiment
    assert (sine.r_0, sine.A, sine.duration) == ([0.0, 0.0, -0.5], [0.5, 0.3, 0.1], 20.0)


def test_an_override_wins_over_its_group() -> None:
    config = composed("experiment=kinematic", "controller.gamma=20", "robot.sensors=[0.1,0.2]", "threads=null")
    assert config.controller.gamma == 20 and config.robot.sensors == [0.1, 0.2] and config.threads is None


@pytest.mark.parametrize("key", ["gama", "controller.gama", "experiment.setpoint", "plant.K_Q"])
def test_an_unknown_key_is_named(key: str) -> None:
    with pytest.raises(HydraException, match=key.rsplit(".", 1)[-1]):
        raw("experiment=kinematic", f"{key}=1")


@pytest.mark.parametrize(
    ("key", "value"),
    [
        ("controller.rate", "fast"),
        ("controller.adaptive", "perhaps"),
        ("plant.substeps", "2.5"),
        ("robot.sensors", "0.1"),
        ("robot.sensors", "[a,b]"),
        ("seed", "[1]"),
        ("experiment.setpoints", "0.3"),
    ],
)
def test_a_wrong_type_is_named(key: str, value: str) -> None:
    with pytest.raises(HydraException) as caught:
        raw("experiment=kinematic", f"{key}={value}")
    told = f"{caught.value} {caught.value.__cause__}"
    assert key in told, told


def test_an_unknown_choice_is_refused_with_what_there_is() -> None:
    with pytest.raises(HydraException, match="dynamic_run_2"):
        raw("experiment=dynamic_run_3")


def test_a_missing_value_is_named() -> None:
    with pytest.raises(ConfigError, match="lengths"):
        composed("experiment=kinematic", "robot.rest_lengths=???")
