"""A small made-up run that the tests of the figures draw, and folders of runs, made up and real."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping
from pathlib import Path

import pytest
import torch
import yaml
from torch import Tensor

from apcc_torch.composition.schema import text
from apcc_torch.experiments import dynamic, kinematic
from apcc_torch.model.backbone import HANGING, PCCBackbone
from apcc_torch.report.backbone_drawing import Snapshots, marker_positions
from apcc_torch.simulation.kinematic import KinematicLog
from composed import changed

WriteRun = Callable[..., Path]


@pytest.fixture
def arm() -> PCCBackbone:
    return PCCBackbone(3, torch.tensor(HANGING, dtype=torch.float64))


@pytest.fixture
def pi() -> Tensor:
    return torch.tensor([0.105, 0.255, 0.24], dtype=torch.float64)


@pytest.fixture
def abscissae() -> Tensor:
    return torch.tensor([0.105, 0.36, 0.6], dtype=torch.float64)


@pytest.fixture
def log(arm: PCCBackbone, pi: Tensor) -> KinematicLog:
    """An arm that bends more and more, and a model that comes to fit it: 41 moments over 4 s."""
    time = torch.linspace(0.0, 4.0, 41, dtype=torch.float64)
    share = (time / 4.0).unsqueeze(-1)
    q_true = share * torch.tensor([0.5, 0.2, 0.01, 0.6, -0.1, 0.02, 0.3, 0.4, -0.01], dtype=torch.float64)
    pi_hat = pi + (1.0 - share) * torch.tensor([0.015, 0.025, 0.03], dtype=torch.float64)
    q_bar = q_true + 0.05 * (1.0 - share)
    x = arm.tip(q_true, pi)
    error = (1.0 - share) * torch.tensor([0.01, 0.02, 0.03], dtype=torch.float64)
    rate = torch.gradient(q_bar, spacing=(time,), dim=0)[0]
    x_d, status = x + 0.01 * share, torch.zeros(41).long()
    return KinematicLog(time, x_d, x, q_true, q_bar, rate, pi_hat, error, 2 * error, status)


@pytest.fixture
def moments(arm: PCCBackbone, pi: Tensor, abscissae: Tensor, log: KinematicLog) -> Snapshots:
    """Every moment of `log`; the target moves."""
    return Snapshots(
        log.time,
        arm.points(log.q_true, pi, 30),
        arm.points(log.q_bar, log.pi_hat, 25),
        marker_positions(arm, log.q_true, pi, abscissae),
        marker_positions(arm, log.q_bar, log.pi_hat, abscissae),
        log.x_d,
    )


@pytest.fixture(scope="session")
def write_run() -> WriteRun:
    """Writes the folder of a made-up run: write_run(folder, {"a": {"b": 1}}, {"error_mm": 2.0}, ["a.b=1"])."""

    def write(
        folder: Path,
        settings: Mapping[str, object] | None = None,
        metrics: Mapping[str, float] | None = None,
        overrides: list[str] | None = None,
    ) -> Path:
        (folder / ".hydra").mkdir(parents=True)
        (folder / ".hydra" / "overrides.yaml").write_text(yaml.safe_dump(overrides or []))
        if settings is not None:
            (folder / "config.yaml").write_text(yaml.safe_dump(settings))
        if metrics is not None:
            (folder / "trajectory.npz").write_bytes(b"")
            (folder / "versions.json").write_text(json.dumps({"torch": "1.2", "seed": 0}))
            (folder / "metrics.json").write_text(json.dumps(metrics))
        return folder

    return write


@pytest.fixture(scope="session")
def real_runs(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder of short runs as the experiments leave them, without figures: two kinematic ones and a dynamic one."""
    root = tmp_path_factory.mktemp("real")
    quick = ("figures=false", "progress=false", "controller.rate=50")
    kinds = {
        "kinematic": [("experiment.duration=0.4", f"adaptation.gain_scale={gain}") for gain in (0.1, 1.0)],
        "dynamic_single": [("experiment.duration=0.2", "plant.settle=0.1")],
    }
    run = {"kinematic": kinematic.run, "dynamic_single": dynamic.run}
    for experiment, changes in kinds.items():
        for k, more in enumerate(changes):
            config = changed(experiment, *quick, *more)
            folder = root / experiment / str(k)
            run[experiment](config, folder)
            (folder / "config.yaml").write_text(text(config))
    return root
