"""What a scene is made of: outlines of arms, tubes around them, moments of runs and of a pursuit."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch

from apcc_torch.errors import DataError
from apcc_torch.experiments import realtime_run
from apcc_torch.experiments.recorded_run import recorded
from apcc_torch.hardware.log_reader import read_log
from apcc_torch.model.arm import Arm
from apcc_torch.viewing.outline import Outline
from apcc_torch.viewing.pursuit import Pursuit
from apcc_torch.viewing.tube import tube
from commands import QUICK, simulate
from composed import composed, composed_realtime
from laws import generator

ON_AN_ARM = (
    "experiment=setpoint", "hardware=lockstep", "hardware.world.step=0.01", "plant.settle=0.1", "loop.hold=0.0",
    "loop.warm_up=3", "loop.fresh_frames=1", "compile=off", "experiment.duration=0.5",
)  # fmt: skip
FAST = (
    "experiment=setpoint", "controller.rate=20", "controller.K=3", "plant.settle=0.5", "plant.substeps=4",
    "compile=off", "experiment.payloads=[0.1]",
)  # fmt: skip


def test_a_tube_is_closed_round_and_turned_outwards() -> None:
    angle = np.linspace(0.0, 1.5, 30)
    curve = 0.3 * np.stack((1.0 - np.cos(angle), 0.0 * angle, -np.sin(angle)), axis=-1)
    vertices, faces = tube(curve, 0.01)
    corners = vertices[faces].astype(float)
    volume = np.einsum("fi,fi->", corners[:, 0], np.cross(corners[:, 1], corners[:, 2])) / 6.0
    assert volume == pytest.approx(np.pi * 0.01**2 * 0.45, rel=0.03), "and its faces look outwards"
    distance = np.linalg.norm(vertices[: 30 * 20].reshape(30, 20, 3) - curve[:, None], axis=-1)
    assert np.allclose(distance, 0.01, atol=1e-6)


def test_an_outline_has_sections_tendons_and_sensors_where_the_model_has_them() -> None:
    arm = Arm(lengths=[0.2, 0.25], mass=0.4, tendon_offset=0.015)
    fine, lengths = arm.dynamics(2).kinematics(), arm.refined(2)
    q = 0.2 * torch.randn(12, dtype=torch.float64, generator=generator(0))
    q[2::3] *= 0.05
    outline = Outline(fine, 2, arm.routing())
    sections, tendons = outline(q, lengths)
    assert sections.shape == (2, 17, 3) and tendons is not None and tendons.shape == (6, 34, 3)
    assert np.allclose(sections[0, 0], 0.0) and np.allclose(sections[0, -1], sections[1, 0])
    assert np.allclose(sections[1, -1], fine.tip(q, lengths))
    away = np.linalg.norm(tendons - sections.reshape(-1, 3), axis=-1)
    assert np.allclose(away[np.isfinite(away)], 0.015)
    assert np.isfinite(away).all(-1).tolist() == [False] * 3 + [True] * 3, "half of them end at the first section"
    assert np.allclose(outline.poses(q, lengths, arm.sensor_places())[:, :3, 3], sections[:, -1])


def test_a_pursuit_arrives_under_a_load_that_is_hung_on_it_and_knows_how_sure_it_is() -> None:
    pursuit = Pursuit(composed(*FAST))
    rest = pursuit.moment().tip
    pursuit.target, pursuit.payload = np.array([0.1, 0.1, -0.52]), 0.3
    while pursuit.error > 1e-3 and pursuit.time < 8.0:
        pursuit.step()
    moment = pursuit.moment()
    assert np.linalg.norm(moment.tip - [0.1, 0.1, -0.52]) < 1e-3 and not pursuit.diverged
    assert moment.covariance is not None and moment.sensors is not None and moment.tension is not None
    deviations = np.sqrt(np.linalg.eigvalsh(moment.covariance))
    assert deviations.shape == (3, 3) and deviations.min() > 1e-5 and deviations.max() < 2e-3
    assert np.allclose(moment.sensors[-1, :3, 3], moment.tip, atol=1e-9)
    pursuit.reset()
    assert np.allclose(pursuit.moment().tip, rest) and pursuit.time == 0.0 and pursuit.payload == 0.3


def test_a_kinematic_run_and_a_folder_without_one(tmp_path: Path) -> None:
    assert simulate(tmp_path, *QUICK, "hydra.run.dir=run", "compile=off").returncode == 0
    run = recorded(tmp_path / "run")
    last = run.moment(len(run.time) - 1, 0)
    assert np.linalg.norm(last.tip - run.x_d[-1, 0].numpy()) == pytest.approx(float(run.error[-1, 0]), abs=1e-9)
    assert recorded(tmp_path / "run" / "trajectory.npz").name == "run"
    (tmp_path / "run" / "trajectory.npz").write_bytes(b"no arrays")
    with pytest.raises(DataError, match=r"trajectory\.npz"):
        recorded(tmp_path / "run")
    with pytest.raises(DataError, match=r"holds no trajectory\.npz and no log\.mcap"):
        recorded(tmp_path)


def test_the_log_of_a_run_is_the_same_with_a_page_and_can_be_viewed(tmp_path: Path) -> None:
    pytest.importorskip("viser", reason="viser is not installed")
    for name, words in {"seen": ("view=browser", "page.port=0"), "unseen": ("view=false",)}.items():
        (tmp_path / name).mkdir()
        realtime_run.run(composed_realtime(*ON_AN_ARM, *words), tmp_path / name)
    seen, unseen = (read_log(tmp_path / name / "log.mcap") for name in ("seen", "unseen"))
    for topic in ("/measurement", "/target", "/controller"):
        assert (seen.topic(topic) == unseen.topic(topic)).all(), topic
    assert (seen.topic("/tendons")["sent"] == unseen.topic("/tendons")["sent"]).all()
    run = recorded(tmp_path / "seen")
    moment = run.moment(len(run.time) - 1, 0)
    assert moment.sensors is not None and moment.tension is not None and moment.model is None
    gap = np.linalg.norm(moment.tip - moment.sensors[-1, :3, 3])
    assert gap == pytest.approx(seen.topic("/controller")["linear_error"][-1, -1], abs=1e-6), "what algorithm 2 left"
    assert np.allclose(moment.target, [0.0, 0.15, -0.5])
