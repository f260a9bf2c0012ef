"""Figures and films of a run from what it left in its folder, without running it again."""

from __future__ import annotations

from pathlib import Path

import torch
from torch import Tensor

from apcc_torch.composition.run_settings import SimulateSettings
from apcc_torch.composition.schema import from_text
from apcc_torch.errors import ApccError, DataError, in_a_line
from apcc_torch.experiments.kinds import KINDS
from apcc_torch.files import read_arrays, read_text


def load_run(folder: Path) -> tuple[SimulateSettings, dict[str, Tensor]]:
    """Settings and trajectory of a run's folder.

    Raises:
        DataError: config.yaml or trajectory.npz cannot be read, or the settings are not those of this version.
    """
    try:
        config = from_text(read_text(folder / "config.yaml"), SimulateSettings)
    except ApccError as error:
        raise DataError(f"config.yaml does not hold this version's settings: {in_a_line(error)}") from error
    return config, read_arrays(folder / "trajectory.npz")


def draw_anew(folder: Path, into: Path, figured: bool, filmed: bool) -> None:
    """Draws a run into `into`/figures from its settings and its trajectory.

    Args:
        folder: The run's.
        into: Another folder.
        figured: Whether figures are wanted.
        filmed: Whether a film is.

    Raises:
        DataError: They cannot be read, or do not belong together.
    """
    config, arrays = load_run(folder)
    if config.experiment.kind not in KINDS:
        raise DataError(f"no figures are known for experiment.kind={config.experiment.kind}")
    try:
        with torch.inference_mode():
            KINDS[config.experiment.kind].redraw(config, arrays, into / "figures", figured, filmed)
    except KeyError as error:
        raise DataError(f"trajectory.npz has no {error}") from error
