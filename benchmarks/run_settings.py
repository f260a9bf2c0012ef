"""Settings of simulated runs, composed as `python -m apcc_torch.simulate` composes them, without progress bars."""

from __future__ import annotations

from apcc_torch import compose
from apcc_torch.composition.run_settings import SimulateSettings

GENTLE = ("controller.null_gain=0.3", "controller.epsilon=0.005")
"""A null-space term with a kink at zero: what the tables of models, laws and forces were taken with."""


def run_settings(*overrides: str) -> SimulateSettings:
    """The settings of one run.

    Raises:
        ConfigError: A value is missing or of the wrong type.
    """
    settings: SimulateSettings = compose("progress=false", *overrides).settings
    return settings
