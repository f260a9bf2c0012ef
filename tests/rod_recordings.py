"""Recordings of an arm that a Cosserat rod stands in for: what a stranger writes down of it, and what is measured."""

from __future__ import annotations

from pathlib import Path

import torch
import yaml

from apcc_torch.model.abscissae import decouple
from apcc_torch.model.arm import Arm
from apcc_torch.model.statics import equilibrium
from apcc_torch.reading import read
from apcc_torch.simulation.rod_plant import RodPlant, RodPlantSettings

ARM = {
    "lengths": [0.1, 0.1],
    "mass": 0.04,
    "bending_rigidity": 2.0e-3,
    "axial_rigidity": 2000.0,
    "tendon_offset": 0.005,
    "actuation": {"pulls": 1.0e-3, "pre_stretch": 3.0e-3, "stiffness": 2000.0},
}
"""The arm's file."""
DATA = {
    "data": {
        "arm": "arm.yaml",
        "sessions": {"empty": {"file": "empty.csv", "payload": 0.0}, "loaded": {"file": "loaded.csv", "payload": 0.03}},
        "rest": "rest.csv",
    },
    "recording": {"unit": "mm"},
    "split": {"folds": 2, "fold": 1},
    "every": 2,
    "fit": {"samples": 24, "steps": 4, "rounds": 1},
}
"""The data set's file: all that a stranger writes."""


REST = 12
"""Frames in which it rests."""


def write_recordings(folder: Path, count: int = 100) -> Path:
    """Two sessions with the same inputs, without and with a payload, and a rest; returns the data set's file."""
    arm = read(ARM, Arm)
    rod = RodPlant.dynamics_of(arm, RodPlantSettings(refine=2, radius=0.005))
    lengths = arm.rest_lengths()
    time = 0.25 * torch.arange(count, dtype=torch.float64)
    phase = torch.arange(6, dtype=torch.float64)
    moved = 1.5 * torch.sin(time.unsqueeze(-1) * (1.1 + 0.37 * phase) + phase)
    noise = torch.Generator().manual_seed(4)
    ends = torch.tensor([1, 3])
    assert len(lengths) == len(decouple(lengths.cumsum(0), lengths)[0]) == 2
    sessions = {name: (moved, each["payload"]) for name, each in DATA["data"]["sessions"].items()}  # type: ignore[index]
    for name, (inputs, payload) in {**sessions, "rest": (0.0 * moved[:REST], 0.0)}.items():
        found = equilibrium(
            rod, routing=arm.routing(), tendon_lengths=-1e-3 * inputs - arm.actuation.pre_stretch,
            compliance=1.0 / arm.actuation.stiffness,
            payload=torch.full((len(inputs),), payload, dtype=torch.float64),
        )  # fmt: skip
        assert bool(found.converged.all())
        pose = rod.kinematics().pose(found.q, rod.lengths, torch.ones(2, dtype=torch.float64), ends)
        places = 1e3 * pose[..., :3, 3]
        places = places + 0.1 * torch.randn(places.shape, generator=noise, dtype=torch.float64)
        lines = ["t,a,b,c,d,e,f,x1,y1,z1,x2,y2,z2"]
        rows = torch.cat((time[: len(inputs)].unsqueeze(-1), inputs, places.flatten(1)), -1).tolist()
        lines += [",".join(f"{cell:.6f}" for cell in row) for row in rows]
        (folder / f"{name}.csv").write_text("\n".join(lines) + "\n")
    (folder / "arm.yaml").write_text(yaml.safe_dump(ARM))
    (folder / "data.yaml").write_text(yaml.safe_dump(DATA))
    return folder / "data.yaml"
