"""A small arm to identify: two sections, six tendons that can go slack, known parameters, made-up recordings."""

from __future__ import annotations

import math
from pathlib import Path

import torch
from torch import Tensor

from apcc_torch.identification.parameters import Block, Parameters
from apcc_torch.identification.tendon_arm import Drive, Layout, TendonArm, block_sizes

LAYOUT = Layout(2, tuple(range(6)), (1e-3,) * 6, (1, 1, 1, 2, 2, 2), (1, 2), (0.02, 0.02))
ANGLES = [2 * math.pi / 3 * k + math.pi / 6 * s for s in range(2) for k in range(3)]
NOMINAL: dict[str, list[float]] = {
    "rest_length": [0.1],
    "angle": ANGLES,
    "offset": [0.005],
    "input_scale": [1.0],
    "pre_stretch": [5e-4],
    "tendon_stiffness": [3000.0],
    "bending_stiffness": [1e-3],
    "axial_stiffness": [5000.0],
    "rest_bend": [0.0],
    "friction": [0.1],
    "time_constant": [1e-3],
    "gravity": [0.0, 0.0, -9.81],
    "base_position": [0.0],
    "base_rotation": [math.pi, 0.0, 0.0],
    "mount": [0.0],
}


def parameters(**spreads: float) -> Parameters:
    """The arm's blocks, of which those named are fitted."""
    blocks = {}
    for name, (unit, logarithmic, labels) in block_sizes(LAYOUT).items():
        nominal = torch.tensor(NOMINAL[name], dtype=torch.float64).expand(len(labels)).clone()
        spread = torch.full_like(nominal, spreads.get(name, 0.0))
        blocks[name] = Block(nominal, spread, unit, tuple(labels), logarithmic)
    return Parameters(blocks)


def random_drive(count: int, seed: int, reach: float = 3.0) -> Drive:
    """Inputs in mm, each tendon by itself, negative ones slack; no friction to speak of."""
    generator = torch.Generator().manual_seed(seed)
    inputs = reach * (2.0 * torch.rand(count, 6, generator=generator, dtype=torch.float64) - 1.0)
    return Drive(inputs.unsqueeze(1), torch.zeros(count, 1, dtype=torch.float64), torch.zeros_like(inputs))


def measured(truth: Parameters, z: Tensor, drive: Drive, noise: float, seed: int) -> Tensor:
    """Positions (N, k, 3) of the arm with the parameters z, and white noise of so many m a coordinate."""
    clean = TendonArm(LAYOUT).predict(drive, truth.values(z))
    generator = torch.Generator().manual_seed(seed)
    return clean + noise * torch.randn(clean.shape, generator=generator, dtype=clean.dtype)


ARM_YAML = """# @package _global_
name: small
recording:
  layout: table
  inputs: [a, b, c, d, e, f]
  bodies: [[x1, y1, z1], [x2, y2, z2]]
  unit: 1.0e-3
  time: t
  group: move
masses: [0.02, 0.02]
bodies: [1, 2]
tendons: {inputs: [0, 1, 2, 3, 4, 5], pulls: [1.0e-3, 1.0e-3, 1.0e-3, 1.0e-3, 1.0e-3, 1.0e-3], ends: [1, 1, 1, 2, 2, 2]}
blocks:
"""
FITTED = {"pre_stretch": 3e-4, "offset": 0.1, "base_position": 2e-3, "bending_stiffness": 0.3}


def write_recording(folder: Path, count: int = 160) -> Path:
    """A CSV file of the small arm in eight movements, and conf/arm/small.yaml for it in `folder`; returns the file."""
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
    blocks = [f"  {name}: {{nominal: {NOMINAL[name] if len(NOMINAL[name]) > 1 else NOMINAL[name][0]}, "
              f"spread: {FITTED.get(name, 0.0)}}}" for name in NOMINAL]  # fmt: skip
    end = "\nsplit: {by: groups, folds: 4, fold: 1}\nfit: {samples: 100, geometric: [offset, base_position]}\n"
    (folder / "arm").mkdir()
    (folder / "arm" / "small.yaml").write_text(ARM_YAML + "\n".join(blocks) + end)
    return path
