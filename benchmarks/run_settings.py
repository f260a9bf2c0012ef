"""Settings of simulated runs, composed as `python -m apcc_torch.simulate` composes them, without progress bars."""

from __future__ import annotations

from hydra import compose, initialize_config_dir
from hydra.core.config_store import ConfigStore

from apcc_torch.conf_path import conf_path
from apcc_torch.configs.schema import SimulateConfig
from apcc_torch.configs.typed import typed


def run_settings(*overrides: str) -> SimulateConfig:
    """The settings of one run.

    Raises:
        ConfigError: A value is missing or of the wrong type.
    """
    ConfigStore.instance().store(name="simulate_schema", node=SimulateConfig)
    with initialize_config_dir(conf_path(), version_base="1.3"):
        return typed(compose("simulate", ["progress=false", *overrides]), SimulateConfig)
