"""Settings composed from conf/ as the programs compose them."""

from __future__ import annotations

from functools import cache
from pathlib import Path

from hydra import compose, initialize_config_dir
from omegaconf import DictConfig, OmegaConf

from apcc_torch.composition.arm_file import arm_override, spelled
from apcc_torch.composition.data_file import data_override
from apcc_torch.composition.evaluate import EvaluateSettings
from apcc_torch.composition.export import ExportSettings
from apcc_torch.composition.identify import IdentifySettings
from apcc_torch.composition.realtime import RealtimeSettings
from apcc_torch.composition.run_settings import SimulateSettings
from apcc_torch.composition.schema import typed
from apcc_torch.conf_path import conf_path
from apcc_torch.recordings.data_set import set_names
from apcc_torch.settings import Settings
from apcc_torch.sweeps.schemas import keep_schema

keep_schema("simulate_schema", SimulateSettings)
keep_schema("realtime_schema", RealtimeSettings)
keep_schema("identify_schema", IdentifySettings)
keep_schema("evaluate_schema", EvaluateSettings)
keep_schema("export_schema", ExportSettings)

# Experiments that only the program for an arm, real or simulated, can run.
ON_AN_ARM = {"calibration", "experiment_1", "experiment_2"}


def with_data(overrides: tuple[str, ...], root: type[Settings]) -> list[str]:
    """The overrides with `data=` spelled out as the programs do; a file that is not there stands for a recording."""
    words = [word for word in overrides if word.startswith("data=")]
    path = words[0].removeprefix("data=") if words else ""
    if not words:
        return list(overrides)
    if path.startswith("{") or path in set_names() or Path(path).exists():
        return data_override(overrides, root)
    alone = {"name": "recording", "folder": "/nowhere", "sessions": {"recording": {"file": path}}}
    return [f"data={spelled(alone)}" if word == words[0] else word for word in overrides]


def raw(*overrides: str) -> DictConfig:
    """What hydra makes of the overrides."""
    with initialize_config_dir(conf_path(), version_base="1.3"):
        return compose("simulate", arm_override(with_data(overrides, SimulateSettings)))


def composed(*overrides: str) -> SimulateSettings:
    """The settings as the experiments take them; those in which no file takes part are composed once."""
    if any("/" in word or word.endswith(".yaml") for word in overrides):
        return typed(raw(*overrides), SimulateSettings)
    return _composed(*overrides)


@cache
def _composed(*overrides: str) -> SimulateSettings:
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
        words = arm_override(with_data(overrides, IdentifySettings))
        return typed(compose("identify", words), IdentifySettings)


def composed_evaluate(*overrides: str) -> EvaluateSettings:
    """The settings of an evaluation."""
    with initialize_config_dir(conf_path(), version_base="1.3"):
        return typed(compose("evaluate", arm_override(data_override(overrides))), EvaluateSettings)


@cache
def _plain(experiment: str) -> DictConfig:
    return raw(f"experiment={experiment}")


def changed(experiment: str, *changes: str) -> SimulateSettings:
    """`composed` of an experiment and changed keys, without choices of groups: much faster where many are tried."""
    data = {}
    for word in [word for word in changes if word.startswith("data=")]:
        path = Path(word.removeprefix("data=")).absolute()
        file = {"file": "" if path.is_dir() else path.name}
        data = {"name": "made", "folder": str(path if path.is_dir() else path.parent), "sessions": {"recording": file}}
    rest = [word for word in changes if not word.startswith("data=")]
    cfg = OmegaConf.merge(_plain(experiment), {"data": data}, OmegaConf.from_dotlist(rest))
    assert isinstance(cfg, DictConfig)
    return typed(cfg, SimulateSettings)


def composed_export(*overrides: str) -> ExportSettings:
    """The settings of a library; its folder is none of them."""
    words = [word for word in overrides if not word.startswith("out=")]
    with initialize_config_dir(conf_path(), version_base="1.3"):
        return typed(compose("export", arm_override(words)), ExportSettings)
