"""A small arm to identify: two sections, six tendons that can go slack, known parameters, made-up recordings."""

from __future__ import annotations

from pathlib import Path

import torch
import yaml
from torch import Tensor

from apcc_torch.identification.arm_blocks import Spreads, arm_parameters
from apcc_torch.identification.parameters import Parameters
from apcc_torch.identification.tendon_arm import Drive, TendonArm
from apcc_torch.model.arm import Arm
from apcc_torch.reading import read
from apcc_torch.settings import names

KEYS = {
    "lengths": [0.1, 0.1],
    "mass": 0.04,
    "bending_rigidity": 1.0e-3,
    "axial_rigidity": 5000.0,
    "tendon_offset": 0.005,
    "actuation": {"pulls": 1.0e-3, "pre_stretch": 5.0e-4},
}
"""The arm's file: few keys, all else by default."""
SMALL = read(KEYS | {"actuation": {**KEYS["actuation"], "friction": 0.1}}, Arm)  # type: ignore[dict-item]


def parameters(**spreads: float) -> Parameters:
    """The arm's blocks, of which those named are fitted."""
    return arm_parameters(SMALL, Spreads(**(dict.fromkeys(names(Spreads), 0.0) | spreads)))


def random_drive(count: int, seed: int, reach: float = 3.0) -> Drive:
    """Inputs in mm, each tendon by itself, negative ones slack; no friction to speak of."""
    generator = torch.Generator().manual_seed(seed)
    inputs = reach * (2.0 * torch.rand(count, 6, generator=generator, dtype=torch.float64) - 1.0)
    return Drive(inputs.unsqueeze(1), torch.zeros(count, 1, dtype=torch.float64), torch.zeros_like(inputs))


def measured(truth: Parameters, z: Tensor, drive: Drive, noise: float, seed: int) -> Tensor:
    """Positions (N, k, 3) of the arm with the parameters z, and white noise of so many m a coordinate."""
    clean = TendonArm(SMALL).predict(drive, truth.values(z))
    generator = torch.Generator().manual_seed(seed)
    return clean + noise * torch.randn(clean.shape, generator=generator, dtype=clean.dtype)


FITTED = {"pre_stretch": 3e-4, "offset": 0.1, "base_position": 2e-3, "bending_rigidity": 0.3}
READ = (
    "recording.inputs=[a,b,c,d,e,f]",
    "recording.bodies=[[x1,y1,z1],[x2,y2,z2]]",
    "recording.unit=1.0e-3",
    "recording.time=t",
    "recording.group=move",
)
"""How the recording is read."""
HELD = [f"spread.{name}=0" for name in names(Spreads) if name not in FITTED]
FIT = (
    *(f"spread.{name}={spread}" for name, spread in FITTED.items()),
    *HELD,
    *("split.by=groups", "split.folds=4", "split.fold=1", "fit.samples=100"),
)
"""What is fitted to it."""


def write_recording(folder: Path, count: int = 160) -> Path:
    """A CSV file of the small arm in eight movements, beside it the arm's own file, small.yaml; returns the former."""
    truth = parameters(**FITTED)
    z = torch.linspace(-0.8, 0.9, len(truth), dtype=torch.float64)
    drive = random_drive(count, seed=5)
    positions = 1e3 * measured(truth, z, drive, noise=1e-4, seed=6).flatten(1)
    lines = ["t,move,a,b,c,d,e,f,x1,y1,z1,x2,y2,z2"]
    for n in range(count):
        cells = [*drive.history[n, 0].tolist(), *positions[n].tolist()]
        lines.append(f"{0.5 * n},move {8 * n // count}," + ",".join(f"{cell:.6f}" for cell in cells))
    path = folder / "recording.csv"
    path.write_text("\n".join(lines) + "\n")
    (folder / "small.yaml").write_text(yaml.safe_dump(KEYS))
    return path
