"""Settings composed from conf/ as the programs compose them."""

from __future__ import annotations

from functools import cache

from hydra import compose, initialize_config_dir
from hydra.core.config_store import ConfigStore
from omegaconf import DictConfig, OmegaConf

from apcc_torch.composition.arm_file import arm_override
from apcc_torch.composition.data_file import data_override
from apcc_torch.composition.evaluate import EvaluateSettings
from apcc_torch.composition.identify import IdentifySettings
from apcc_torch.composition.realtime import RealtimeSettings
from apcc_torch.composition.run_settings import SimulateSettings
from apcc_torch.composition.schema import schema, typed
from apcc_torch.conf_path import conf_path

ConfigStore.instance().store(name="simulate_schema", node=schema(SimulateSettings))
ConfigStore.instance().store(name="realtime_schema", node=schema(RealtimeSettings))
ConfigStore.instance().store(name="identify_schema", node=schema(IdentifySettings))
ConfigStore.instance().store(name="evaluate_schema", node=schema(EvaluateSettings))

# Experiments that only the program for an arm, real or simulated, can run.
ON_AN_ARM = {"calibration", "experiment_1", "experiment_2"}


def raw(*overrides: str) -> DictConfig:
    """What hydra makes of the overrides."""
    with initialize_config_dir(conf_path(), version_base="1.3"):
        return compose("simulate", arm_override(overrides))


def composed(*overrides: str) -> SimulateSettings:
    """The settings as the experiments take them."""
    return typed(raw(*overrides), SimulateSettings)


def raw_realtime(*overrides: str) -> DictConfig:
    """What hydra makes of the overrides for the arm in real time."""
    with initialize_config_dir(conf_path(), version_base="1.3"):
        return compose("realtime", arm_override(overrides))


def composed_realtime(*overrides: str) -> RealtimeSettings:
    """The settings of a run in real time."""
    return typed(raw_realtime(*overrides), RealtimeSettings)


def composed_identify(*overrides: str) -> IdentifySettings:
    """The settings of an identification."""
    with initialize_config_dir(conf_path(), version_base="1.3"):
        return typed(compose("identify", arm_override(overrides)), IdentifySettings)


def composed_evaluate(*overrides: str) -> EvaluateSettings:
    """The settings of an evaluation."""
    with initialize_config_dir(conf_path(), version_base="1.3"):
        return typed(compose("evaluate", arm_override(data_override(overrides))), EvaluateSettings)


@cache
def _plain(experiment: str) -> DictConfig:
    return raw(f"experiment={experiment}")


def changed(experiment: str, *changes: str) -> SimulateSettings:
    """`composed` of an experiment and changed keys, without choices of groups: much faster where many are tried."""
    cfg = OmegaConf.merge(_plain(experiment), OmegaConf.from_dotlist(list(changes)))
    assert isinstance(cfg, DictConfig)
    return typed(cfg, SimulateSettings)
