"""Settings composed in Python as the command line composes them, and what they make."""

from __future__ import annotations

from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass
from pathlib import Path

import torch
from hydra import compose as hydra_compose
from hydra import initialize_config_dir
from hydra.core.global_hydra import GlobalHydra
from hydra.errors import HydraException
from omegaconf.errors import OmegaConfBaseException

from apcc_torch.composition.arm_file import arm_override
from apcc_torch.composition.build import Builder
from apcc_torch.composition.dynamics_law import with_dynamics
from apcc_torch.composition.run_settings import SimulateSettings
from apcc_torch.composition.schema import check_words, sentence, text, typed
from apcc_torch.composition.unread import check_given, of_a_simulation
from apcc_torch.conf_path import conf_path
from apcc_torch.control.composite_controller import CompositeController
from apcc_torch.control.controller import APCCController
from apcc_torch.control.trajectory import SineTrajectory
from apcc_torch.errors import ConfigError
from apcc_torch.experiments.run import run
from apcc_torch.files import write_atomically
from apcc_torch.simulation.plant import Plant
from apcc_torch.sweeps.schemas import keep_schema

keep_schema("simulate_schema", SimulateSettings)


@dataclass(frozen=True)
class Composed:
    """The settings of a run, and the objects that they describe.

    settings: All of them.
    """

    settings: SimulateSettings

    def controller(self) -> APCCController | CompositeController:
        """The controller."""
        build = Builder(self.settings)
        return with_dynamics(build, build.controller())

    def plant(self) -> Plant:
        """The true arm, a row for every set-point with every payload; a row for every payload of a trajectory."""
        build = Builder(self.settings)
        return build.plant(build.grid()[1] if self.settings.experiment.setpoints else build.payloads())

    def trajectory(self) -> SineTrajectory:
        """Where the end effector is to go, in an experiment without set-points."""
        return Builder(self.settings).sine()

    def first_estimate(self) -> torch.Tensor:
        """(n_b,) pi_hat at the start, m."""
        return Builder(self.settings).first_estimate()

    def run(self, folder: str | Path) -> dict[str, float]:
        """Runs the experiment into a folder, as the command does; returns its metrics.

        Raises:
            ConfigError, ValueRangeError: A setting has no meaning.
        """
        path = Path(folder)
        path.mkdir(parents=True, exist_ok=True)
        write_atomically(path / "config.yaml", text(self.settings))
        return run(self.settings, path)

    def __str__(self) -> str:
        return text(self.settings)


def initialised() -> AbstractContextManager[None]:
    """Hydra on the package's configurations; as it is where it runs, with the folders that its user named."""
    ready = GlobalHydra.instance().is_initialized()
    return nullcontext() if ready else initialize_config_dir(conf_path(), version_base="1.3")


def compose(*overrides: str) -> Composed:
    """Settings as `python -m apcc_torch.simulate` makes them of the same words.

    Args:
        *overrides: Such as "experiment=dynamic_run_2" and "controller.K=1.2".

    Raises:
        ConfigError, ValueRangeError: A key or choice is unknown, or a value has no meaning.

    Example:
        >>> composed = compose("experiment=dynamic_run_2", "controller.K=1.2")
        >>> composed.settings.controller.K, composed.settings.experiment.duration
        (1.2, 10.0)
    """
    words = arm_override(overrides)
    if not GlobalHydra.instance().is_initialized():
        check_words(words, SimulateSettings, "simulate")
    try:
        with initialised():
            cfg = hydra_compose("simulate", words)
    except (HydraException, OmegaConfBaseException) as error:
        raise ConfigError(sentence(error)) from error
    settings = typed(cfg, SimulateSettings)
    check_given(of_a_simulation, [settings], words)
    return Composed(settings)
