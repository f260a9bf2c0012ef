"""What every run leaves behind: metrics, data, versions."""

from __future__ import annotations

import platform
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from torch import Tensor
from tqdm import tqdm

import apcc_torch
from apcc_torch.files import write_arrays, write_json
from apcc_torch.simulation.progress import Progress


def progress_bar(label: str, shown: bool) -> Progress:
    """A progress bar over steps; silent where it is not wanted or there is no terminal."""
    return lambda steps: tqdm(steps, desc=label, disable=None if shown else True, leave=False, dynamic_ncols=True)


def versions() -> dict[str, str]:
    """Versions that a result depends on."""
    return {
        "apcc_torch": apcc_torch.__version__,
        "torch": torch.__version__,
        "numpy": np.__version__,
        "python": platform.python_version(),
        "machine": platform.machine(),
        "system": platform.system(),
        "torch_threads": str(torch.get_num_threads()),
    }


@dataclass(frozen=True)
class RunFolder:
    """The folder of one run."""

    path: Path

    def write(self, metrics: Mapping[str, float], arrays: Mapping[str, Tensor], seed: int) -> None:
        """Writes trajectory.npz, versions.json and, last, metrics.json: a folder with metrics is complete."""
        write_arrays(self.path / "trajectory.npz", arrays)
        write_json(self.path / "versions.json", {**versions(), "seed": seed})
        write_json(self.path / "metrics.json", metrics)

    @property
    def figures(self) -> Path:
        """Where the figures go."""
        return self.path / "figures"
