"""Every configuration fits the settings; a key or type that does not is refused with its name."""

from __future__ import annotations

import importlib
import re
import warnings
from pathlib import Path

import pytest
from hydra import compose, initialize_config_dir
from hydra.errors import HydraException
from omegaconf import OmegaConf

from apcc_torch.composition.run_settings import SimulateSettings
from apcc_torch.composition.schema import check_words, text, typed
from apcc_torch.conf_path import conf_path
from apcc_torch.control.adaptation import NormalisedLawSettings
from apcc_torch.errors import ConfigError
from apcc_torch.experiments.kinds import KINDS
from apcc_torch.reading import read
from apcc_torch.sweeps.callback import planned
from composed import ON_AN_ARM, changed, composed, raw

CONF = Path(conf_path())
GROUPS = ("adaptation", "arm", "dynamics_law", "feedback", "model", "plant", "pose_filter", "sensors")
NOT_FOR_A_RUN = {"custom", "ftdcr_v6", "trunk"}
"""A class of one's own has to be named; arms that only identification reads."""


def choices(group: str) -> list[str]:
    return sorted(path.stem for path in (CONF / group).glob("*.yaml"))


@pytest.mark.parametrize("experiment", sorted(set(choices("experiment")) - ON_AN_ARM))
def test_every_experiment_composes(experiment: str) -> None:
    config = composed(f"experiment={experiment}")
    assert isinstance(config, SimulateSettings)
    assert config.experiment.name == experiment
    assert config.experiment.kind in KINDS
    assert OmegaConf.missing_keys(raw(f"experiment={experiment}")) == set()


@pytest.mark.parametrize("experiment", ["kinematic", "dynamic_run_2", "replay"])
def test_every_choice_composes_with_every_kind_of_experiment(experiment: str) -> None:
    available = {group: [name for name in choices(group) if name not in NOT_FOR_A_RUN] for group in GROUPS}
    for k in range(max(len(names) for names in available.values())):
        chosen = {group: names[k % len(names)] for group, names in available.items()}
        config = composed(f"experiment={experiment}", *(f"{group}={name}" for group, name in chosen.items()))
        assert config.experiment.name == experiment
        for group in ("adaptation", "dynamics_law", "pose_filter"):
            assert (getattr(config, group) is None) == (chosen[group] == "none"), "a choice replaces the whole"


@pytest.mark.parametrize("state", ["feedback", "exact"])
def test_both_states_compose(state: str) -> None:
    assert composed("experiment=kinematic", f"state={state}").state == state


def test_the_proofs_case_has_the_printed_law_unless_another_is_chosen() -> None:
    law = composed("experiment=kinematic", "state=exact").adaptation
    assert law == composed("experiment=kinematic", "adaptation=proof").adaptation
    assert (law.normalisation, law.dead_zone) == (0.0, 0.0)  # type: ignore[union-attr]
    chosen = composed("experiment=kinematic", "state=exact", "adaptation=normalised").adaptation
    assert chosen == NormalisedLawSettings()


@pytest.mark.parametrize("sweep", choices("sweep"))
def test_every_sweep_composes_and_sweeps_keys_that_there_are(sweep: str) -> None:
    if "optuna" in sweep:
        pytest.importorskip("hydra_plugins.hydra_optuna_sweeper")
    asked = ["experiment=kinematic" if "gains" in sweep else "experiment=dynamic_run_2", f"sweep={sweep}"]
    with initialize_config_dir(str(CONF), version_base="1.3"):
        config = compose("simulate", asked, return_hydra_config=True)
    assert config.hydra.mode.name == "MULTIRUN"
    plan = planned(config)
    assert plan.keys == set(config.hydra.sweeper.params) and plan.total > 1
    for key in config.hydra.sweeper.params:
        read_key(typed(config, SimulateSettings), key)


def read_key(settings: object, key: str) -> object:
    for name in key.split("."):
        settings = getattr(settings, name)
    return settings


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


DOCUMENTED = (*GROUPS, "experiment", "state", "sweep", "hydra/launcher")
NAMES = {"_target_", "kind", "mode", "name", "objective", "state", "subset", "reach", "target", "base", "regressor"}
"""What says itself, or is what the head of its file says."""


@pytest.mark.parametrize("group", DOCUMENTED)
def test_every_value_says_what_it_is(group: str) -> None:
    for path in sorted((CONF / group).glob("*.yaml")):
        lines = path.read_text(encoding="utf-8").splitlines()
        assert any(line.startswith("#") and "@package" not in line for line in lines), f"{path}: what is it?"
        if path.stem in NOT_FOR_A_RUN:
            continue  # of identification
        values = [(line, re.match(r"\s*([\w.]+): +[^\s#]", line)) for line in lines]
        silent = [line for line, key in values if key and key[1] not in NAMES and "#" not in line]
        assert not silent, f"{path.relative_to(CONF)}: {silent}"


def test_the_papers_numbers() -> None:
    config = composed("experiment=dynamic_run_2")
    plant = config.plant
    assert plant.arm == type(plant.arm)(), "the plant is the arm"  # type: ignore[attr-defined]
    assert config.arm.refined(plant.refine).tolist() == [0.0525, 0.0525, 0.1275, 0.1275, 0.12, 0.12]  # type: ignore[attr-defined]
    assert (plant.pid.K_P, plant.pid.K_I, plant.pid.K_D) == (750.0, 1.0, 5.0)  # type: ignore[attr-defined]
    assert (config.arm.axial_stiffness, config.arm.bending_stiffness) == (100.0, 0.778)
    assert config.arm.sensor_places().tolist() == pytest.approx([0.105, 0.36, 0.60], abs=1e-15)
    assert config.arm.racks is None, "tendons end where the sections do"
    assert config.experiment.payloads == (0.0, 0.25, 0.5)
    assert config.experiment.setpoints is not None and len(config.experiment.setpoints) == 10
    assert config.experiment.setpoints[0] == [0.325, 0.15, -0.275]
    kinematic = composed("experiment=kinematic").experiment
    assert (kinematic.r_0, kinematic.A, kinematic.duration) == ((0.0, 0.0, -0.5), (0.5, 0.3, 0.1), 20.0)


def test_an_override_wins_over_its_group() -> None:
    config = composed("experiment=kinematic", "adaptation.gamma=20", "arm.sensors=[0.1,0.2]", "threads=null")
    assert config.adaptation.gamma == 20 and config.arm.sensors == (0.1, 0.2)  # type: ignore[union-attr]
    assert config.threads is None


@pytest.mark.parametrize("value", ["[1,2,3]", "[along,1,2]", "7", "[[1,0,0],[0,1,0],[0,0,2]]"])
def test_any_form_of_a_value_takes_the_place_of_any_other(value: str) -> None:
    # The experiment's own Gamma is a profile.
    assert composed("experiment=kinematic", f"adaptation.gamma={value}").adaptation is not None


@pytest.mark.parametrize(
    ("key", "meant"),
    [
        ("adaptation.gama", "did you mean gamma"),
        ("controller.null_gian", "did you mean null_gain"),
        ("experiment.setpoint", "did you mean setpoints"),
        ("plant.pid.K_Q", "did you mean K_"),
        ("plant.arm.masss", "did you mean mass"),
        ("controller.gamma", "it has K, null_gain"),
    ],
)
def test_an_unknown_key_of_a_group_is_named_with_what_may_be_meant(key: str, meant: str) -> None:
    with pytest.raises(ConfigError, match=f"{key} is no setting; {meant}"):
        changed("kinematic", f"{key}=1")


@pytest.mark.parametrize(
    ("word", "said"),
    [
        ("gama=1", "gama is no setting; it has model"),
        ("progres=false", "progres is no setting; did you mean progress"),
        ("experimnt.duration=1", "experimnt is no setting; did you mean experiment"),
        ("sensor=mocap", "sensor is no setting; did you mean sensors"),
        ("controller.gian=1", "controller.gian is no setting; it has K"),
        ("integral.rech=1", "integral.rech is no setting; did you mean reach"),
    ],
)
def test_an_unknown_word_of_a_command_line_is_named_with_what_may_be_meant(word: str, said: str) -> None:
    with pytest.raises(ConfigError, match=said):
        check_words(["experiment=kinematic", word], SimulateSettings, "simulate")


def test_other_words_are_hydras() -> None:
    check_words(
        ["-m", "hydra.run.dir=x", "hydra/launcher=basic", "sweep=window", "state=exact"], SimulateSettings, "simulate"
    )
    check_words(["plant.pid.K_P=1", "adaptation.what=1", "integral.gain=1", "seed=1"], SimulateSettings, "simulate")
    check_words(["+more=1", "~sensors", "-cd", "own", "mine=1"], SimulateSettings, "simulate")


def test_what_is_added_and_read_by_nothing_is_named() -> None:
    with pytest.raises(ConfigError, match="foo is no setting"):
        composed("experiment=kinematic", "+foo=1")


@pytest.mark.parametrize(
    ("words", "named"),
    [
        (("adaptation=none", "adaptation.gamma=3"), "adaptation.gamma is read by nothing: there is no adaptation here"),
        (("dynamics_law.memory=1",), "dynamics_law.memory is read by nothing"),
        (("adaptation=shape", "adaptation.gamma=1"), "adaptation.gamma is no setting"),
    ],
)
def test_a_key_of_a_part_that_is_not_there_is_named(words: tuple[str, ...], named: str) -> None:
    with pytest.raises(ConfigError, match=named):
        composed("experiment=kinematic", *words)


def test_a_part_that_may_be_left_out_is_there_once_one_of_its_keys_is() -> None:
    assert composed("experiment=kinematic").integral is None
    assert composed("experiment=kinematic", "integral.reach=0.002").integral is not None
    assert composed("experiment=kinematic", "integral=null").integral is None
    with pytest.raises(ConfigError, match=r"integral\.rech is no setting; did you mean reach"):
        composed("experiment=kinematic", "integral.rech=1")


@pytest.mark.parametrize(
    ("key", "value"),
    [
        ("controller.rate", "fast"),
        ("controller.adaptive", "perhaps"),
        ("plant.substeps", "2.5"),
        ("arm.sensors", "0.1"),
        ("arm.sensors", "[a,b]"),
        ("seed", "[1]"),
        ("experiment.setpoints", "0.3"),
        ("experiment", "3"),
        ("plant.pid", "stiff"),
    ],
)
def test_a_wrong_type_is_named(key: str, value: str) -> None:
    with pytest.raises(ConfigError, match=key.replace(".", r"\.")):
        changed("kinematic", f"{key}={value}")


def test_an_unknown_choice_is_refused_with_what_there_is() -> None:
    with pytest.raises(HydraException, match="dynamic_run_2"):
        raw("experiment=dynamic_run_3")


@pytest.mark.parametrize("key", ["arm.lengths", "experiment.name"])
def test_a_missing_value_is_named(key: str) -> None:
    with pytest.raises(ConfigError, match=f"{key} must be given"):
        composed("experiment=kinematic", f"{key}=???")


@pytest.mark.parametrize("experiment", ["kinematic", "dynamic_run_2", "dynamic_run_2_composite", "replay"])
def test_settings_are_written_as_they_are_read(experiment: str) -> None:
    config = composed(f"experiment={experiment}")
    assert read(OmegaConf.to_container(OmegaConf.create(text(config))), SimulateSettings) == config  # type: ignore[arg-type]
