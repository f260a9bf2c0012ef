"""Settings of simulated runs, composed as `python -m apcc_torch.simulate` composes them, without progress bars."""

from __future__ import annotations

from apcc_torch.composition.typed import typed
from hydra import compose, initialize_config_dir
from hydra.core.config_store import ConfigStore

from apcc_torch.composition.schema import SimulateConfig
from apcc_torch.conf_path import conf_path

GENTLE = ("controller.null_gain=0.3", "controller.epsilon=0.005")
"""A null-space term with a kink at zero: what the tables of models, laws and forces were taken with."""
BANK = ("residual=bank", "residual.nominal_weight=0.002", "residual.elongation_weight=0.02")
"""A bank of models on section V-B's arm."""


def run_settings(*overrides: str) -> SimulateConfig:
    """The settings of one run.

    Raises:
        ConfigError: A value is missing or of the wrong type.
    """
    ConfigStore.instance().store(name="simulate_schema", node=SimulateConfig)
    with initialize_config_dir(conf_path(), version_base="1.3"):
        return typed(compose("simulate", ["progress=false", *overrides]), SimulateConfig)
