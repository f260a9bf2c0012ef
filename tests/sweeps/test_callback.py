"""What hydra's side of a sweep works out before anything runs."""

from __future__ import annotations

from pathlib import Path

import pytest
from omegaconf import DictConfig, OmegaConf

from apcc_torch.errors import ConfigError
from apcc_torch.sweeps import callback as sweep
from apcc_torch.sweeps.sweep_folder import SweepFolder


def settings(*task: str, **sweeper: object) -> DictConfig:
    tree = {
        "resume": False,
        "overwrite": False,
        "hydra": {"sweeper": sweeper, "sweep": {"dir": "here"}, "overrides": {"task": list(task), "hydra": []}},
    }
    config = OmegaConf.create(tree)
    assert isinstance(config, DictConfig)
    return config


def test_the_jobs_are_those_of_the_sweeper() -> None:
    params = {"controller.K": "1,2", "seed": "5,6"}
    plan = sweep.planned(settings("experiment=kinematic", "seed=1", "+extra=range(0,3)", params=params))
    # An override on the command line wins over the sweep's own.
    assert plan.total == 6 and plan.keys == {"controller.K", "extra"} and plan.jobs is not None
    first = ["controller.K=1", "seed=1", "experiment=kinematic", "+extra=0"]
    assert plan.jobs[0] == first and plan.brief(first) == "controller.K=1 +extra=0"


def test_a_search_finds_its_jobs_on_the_way() -> None:
    plan = sweep.planned(settings("seed=1", n_trials=20, params={"controller.K": "interval(0.5,3)"}))
    assert (plan.total, plan.keys, plan.jobs) == (20, {"controller.K"}, None)
    assert plan.brief(["seed=1"]) == "(nothing swept)"


def test_a_folder_with_leftovers_alone_may_be_begun_again(tmp_path: Path) -> None:
    (tmp_path / ".0.1.draft").mkdir()
    sweep.prepare(SweepFolder(tmp_path), settings())
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(("plugin", "extra"), sweep.EXTRAS.items())
def test_what_is_not_installed_is_named_with_its_extra(
    plugin: str, extra: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(sweep, "find_spec", lambda name: None)
    with pytest.raises(ConfigError, match=rf"{plugin} is not installed; pip install 'apcc-torch\[{extra}\]'"):
        sweep.check_installed(f"hydra_plugins.{plugin}.module.Class")
    sweep.check_installed("hydra._internal.core_plugins.basic_launcher.BasicLauncher")


def test_the_order_of_overrides_and_how_they_are_run_make_no_other_job() -> None:
    one, other = ["seed=1", "controller.K=2"], ["controller.K=2", "resume=true", "jobs=4", "seed=1"]
    assert sweep.job_key(one) == sweep.job_key(other) != sweep.job_key(["seed=1"])


@pytest.mark.parametrize(
    ("asked", "there", "jobs", "taken"),
    [
        ((), True, 3, "JoblibLauncher"),
        ((), True, 1, "BasicLauncher"),
        ((), False, 3, "BasicLauncher"),
        (("hydra/launcher=basic",), True, 3, "BasicLauncher"),
    ],
)
def test_jobs_run_side_by_side_where_they_can(
    asked: tuple[str, ...], there: bool, jobs: int, taken: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(sweep, "installed", lambda plugin: there)
    config = settings()
    config.jobs = jobs
    config.hydra.launcher = {"_target_": "hydra._internal.core_plugins.basic_launcher.BasicLauncher"}
    config.hydra.overrides.hydra = list(asked)
    sweep.side_by_side(config)
    assert config.hydra.launcher._target_.endswith(taken)
    assert config.hydra.launcher.get("n_jobs", jobs) == jobs
