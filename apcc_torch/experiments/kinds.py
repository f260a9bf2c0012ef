"""The experiments: what `experiment.kind` names, and the module that runs it."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any, Protocol, TypeVar

from torch import Tensor

from apcc_torch.composition.run_settings import SimulateSettings
from apcc_torch.errors import ConfigError
from apcc_torch.experiments import dynamic, kinematic, replay
from apcc_torch.settings import check_choice
from apcc_torch.simulation.progress import Progress

ON_AN_ARM = ("calibration", "tendons")
"""Kinds that need an arm, real or simulated, in real time."""


class Kind(Protocol):
    """What the module of an experiment has."""

    def run(self, config: SimulateSettings, folder: Path) -> dict[str, float]:
        """Runs it, and writes its folder; returns its metrics."""

    def redraw(
        self, config: SimulateSettings, arrays: dict[str, Tensor], into: Path, figured: bool, filmed: bool
    ) -> None:
        """Its figures and its film into a folder, from its trajectory."""


class BatchedKind(Kind, Protocol):
    """What it has where runs can share a tensor batch."""

    def simulate(self, config: SimulateSettings, *, points: int | None, progress: Progress | None) -> Any:
        """The outcome of `points` runs side by side, their settings from `stacking.stacked`."""

    def one_of(self, outcome: Any, config: SimulateSettings, p: int) -> Any:
        """The outcome of run p, with its own settings."""

    def metrics(self, outcome: Any) -> dict[str, float]:
        """Metrics of one run."""

    def arrays(self, outcome: Any) -> dict[str, Tensor]:
        """What its trajectory.npz holds."""

    def loaded(self, config: SimulateSettings, data: Mapping[str, Tensor]) -> Any:
        """The outcome of a run from its trajectory.npz."""

    def draw(self, outcome: Any, folder: Path) -> None:
        """Figures of one run."""


BATCHED: dict[str, BatchedKind] = {"dynamic": dynamic, "kinematic": kinematic}
KINDS: dict[str, Kind] = {**BATCHED, "replay": replay}

Found = TypeVar("Found")


def kind_of(config: SimulateSettings, kinds: Mapping[str, Found], what: str = "experiment.kind") -> Found:
    """The module that runs an experiment.

    Raises:
        ConfigError: There is none, or it needs an arm.
    """
    kind = config.experiment.kind
    if kind in ON_AN_ARM:
        raise ConfigError(f"{what}={kind} needs an arm: python -m apcc_torch.robot experiment={config.experiment.name}")
    return kinds[check_choice(what, kind, tuple(kinds))]
