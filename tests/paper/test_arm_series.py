"""Experiments I and II of the paper on the simulated arm: shortened runs, their tables, figures and formulas."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
import torch
from omegaconf import DictConfig

from apcc_torch.composition.build_realtime import RealtimeBuilder
from apcc_torch.errors import ConfigError
from apcc_torch.experiments import realtime_run as realtime
from apcc_torch.hardware.log_reader import read_log
from apcc_torch.hardware.stops import StopReason
from apcc_torch.model.arm import Arm
from apcc_torch.paper import arm_series as arm_run
from apcc_torch.paper import mapping_study
from apcc_torch.paper.state_feedback_study import estimate, motion
from apcc_torch.paper.tendon_samples import EPSILON, sampled_runs
from composed import composed_realtime, raw_realtime

QUICK = (
    "hardware=lockstep", "hardware.world.step=0.01", "plant.settle=0.5", "loop.hold=0.0",
    "loop.warm_up=3", "loop.fresh_frames=1", "view=false", "compile=off",
)  # fmt: skip


def settings(*overrides: str) -> DictConfig:
    return raw_realtime(*overrides, *QUICK)


@pytest.fixture(scope="module")
def first(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("experiment_1")
    only = "series.only=[run_4,run_8]"
    cfg = settings("experiment=experiment_1", only, "experiment.duration=1.2", "ramp.duration=1.0")
    outcome, metrics = arm_run.run(cfg, folder)
    assert outcome.reason is StopReason.COMPLETED and metrics["runs"] == 2.0, outcome.message
    return folder


def test_experiment_1_has_table_i_of_the_paper() -> None:
    runs = composed_realtime("experiment=experiment_1").series.runs
    assert list(runs) == [f"run_{k}" for k in range(1, 9)]
    lower = np.array([-0.035] * 3 + [-0.075] * 6)
    for overrides in runs.values():
        values = {k: np.array(json.loads(v)) for k, v in (entry.split("=") for entry in overrides)}
        assert (values["ramp.goal"] <= 0).all() and (values["ramp.goal"] >= lower).all()
        run = composed_realtime("experiment=experiment_1", *overrides)
        assert np.allclose(run.arm.rest_lengths(), values["arm.lengths"])
        assert np.allclose(np.cumsum(values["arm.lengths"]), run.arm.sensor_places())
    assert "ramp.goal=[-0.026, -0.013, -0.002, -0.047, -0.046, -0.008, -0.028, -0.023, -0.074]" in runs["run_4"]


def test_experiment_1_draws_as_the_paper_does() -> None:
    runs = sampled_runs(Arm(lengths=[0.105, 0.245, 0.245]), 200, seed=3)
    assert runs["run_1"] == sampled_runs(Arm(lengths=[0.105, 0.245, 0.245]), 1, seed=3)["run_1"]
    values = [dict(entry.split("=") for entry in overrides) for overrides in runs.values()]
    goal, estimate = (np.array([json.loads(v[k]) for v in values]) for k in ("ramp.goal", "ramp.estimate"))
    # The bounds are kept, and reached: within 3 % of 200 draws each.
    lower, off = np.array([-0.035] * 3 + [-0.075] * 6), estimate - [0.105, 0.245, 0.245]
    assert (goal >= lower).all() and (goal <= 0).all() and (goal.min(0) < 0.97 * lower).all()
    assert np.abs(off).max() <= 0.03 and (off.max(0) > 0.029).all() and (off.min(0) < -0.029).all()
    assert np.allclose(goal.mean(0), 0.5 * lower, rtol=0.1)
    planned = arm_run.planned(raw_realtime("experiment=experiment_1", "series.sampled=2", "seed=3"))
    assert [list(run.ramp.goal or ()) for run in planned] == goal[:2].tolist()


def test_the_table_of_the_paper_fits_what_is_drawn() -> None:
    runs = composed_realtime("experiment=experiment_1").series.runs
    values = [dict(entry.split("=") for entry in overrides) for overrides in runs.values()]
    pi, estimate = (np.array([json.loads(v[k]) for v in values]) for k in ("arm.lengths", "ramp.estimate"))
    assert 0.02 < np.abs(estimate - pi).max() <= EPSILON


def test_the_tendons_go_where_they_are_told(first: Path) -> None:
    log = read_log(first / "run_4" / "log.mcap")
    goal = [-0.026, -0.013, -0.002, -0.047, -0.046, -0.008, -0.028, -0.023, -0.074]
    assert np.abs(log.topic("/tendons")["sent"][-1] - goal).max() < 2e-5  # a tick
    assert realtime.replay_log(log).difference == 0.0


def test_each_estimator_explains_the_sensors_as_well_as_it_can(first: Path) -> None:
    config, seen = motion(first / "run_4")
    found = estimate(config, seen)
    assert set(found) == {(c, m) for c in ("non-decoupled", "decoupled") for m in ("pose", "position")}
    # Nine coordinates and nine numbers of position: a model with its sections' ends on the sensors meets them.
    e = found["non-decoupled", "position"]
    assert float(e.linear[-10:].max()) < 1e-3
    assert torch.allclose(e.points[-1, -1], e.sensors[-1, -1], atol=1e-3)
    assert float(found["non-decoupled", "pose"].angular.mean()) < 0.2


def test_experiment_1_leaves_a_table_and_its_figures(first: Path) -> None:
    table = json.loads((first / "table.json").read_text())
    assert set(table) == {"run_4", "run_8"} and table["run_8"]["pi_hat_m"] == [0.084, 0.254, 0.26]
    assert set(table["run_4"]["decoupled, pose"]) >= {"linear_end_mm", "angular_end_rad"}
    assert len((first / "table.txt").read_text().splitlines()) == 3
    assert sorted(p.name for p in (first / "figures").iterdir()) == [f"fig_{k}.png" for k in (23, 24, 25, 26)]


def test_experiment_2_has_the_papers_gains() -> None:
    runs = composed_realtime("experiment=experiment_2").series.runs
    assert len(runs) == 14
    assert {"controller.K=1.5", "adaptation.gamma=40.0", "feedback.mode=position"} <= set(runs["coupled_1_adaptive"])
    assert {"controller.K=1.5", "adaptation.gamma=30.0", "feedback.mode=pose"} <= set(runs["coupled_3_adaptive"])
    assert {"controller.K=2.0", "experiment.payloads=[0.21]"} <= set(runs["corrected_3_standard"])
    for name, overrides in runs.items():
        layout, run, _ = mapping_study.split(name)
        assert f"arm.layout={'coupled' if layout == 'coupled' else 'independent'}" in overrides
        assert ("experiment.payloads=[0.21]" in overrides) == (run == "3")


def test_experiment_2_measures_the_actuation_mismatch(tmp_path: Path) -> None:
    only = "series.only=[coupled_2_standard,corrected_2_standard]"
    outcome, metrics = arm_run.run(settings("experiment=experiment_2", only, "experiment.duration=1.0"), tmp_path)
    assert outcome.reason is StopReason.COMPLETED, outcome.message
    assert metrics["runs"] == 2.0 and len(metrics) == 2 * 8 + 1
    names = {p.relative_to(tmp_path / "figures").as_posix() for p in (tmp_path / "figures").rglob("*.png")}
    assert names == {f"{layout}/fig_{k}.png" for layout in ("coupled", "corrected") for k in (31, 32, 33, 34, 35)}
    # Eq. (53) by hand, at the last step of one run.
    record = read_log(tmp_path / "coupled_2_standard" / "log.mcap")
    step = record.topic("/controller")[-1]
    tip = record.topic("/measurement")["poses"][-1].reshape(3, 4, 4)[-1, :3, 3]
    backbone = RealtimeBuilder(realtime.settings_of(record)).model.backbone()
    there = backbone.tip(torch.tensor(step["q_d"]), torch.tensor(step["pi_hat"])).numpy()
    table = json.loads((tmp_path / "table.json").read_text())
    expected = 1e2 * np.linalg.norm(there - tip)
    assert table["coupled_2_standard"]["mapping_error_end_cm"] == pytest.approx(expected, abs=1e-9)


@pytest.mark.parametrize(
    ("override", "sentence"),
    [
        ("series.only=[run_9]", r"series\.only must be one of run_1"),
        ("series.study=experiment_3", r"series\.study must be one of experiment_1, experiment_2"),
        ("series.only=[]", r"series\.only must name at least one run"),
        ("series.runs.run_1=['ramp.gaol=1']", "gaol"),
    ],
)
def test_a_series_without_meaning_is_refused(tmp_path: Path, override: str, sentence: str) -> None:
    with pytest.raises(ConfigError, match=sentence):
        arm_run.run(settings("experiment=experiment_1", override), tmp_path)


def test_a_ramp_needs_a_goal_for_each_tendon() -> None:
    config = composed_realtime("experiment=experiment_1", "ramp.goal=[0.0]")
    with pytest.raises(ConfigError, match=r"ramp\.goal must have 9 entries"):
        RealtimeBuilder(config).ramp()
    with pytest.raises(ConfigError, match=r"ramp\.goal must be given"):
        RealtimeBuilder(composed_realtime("experiment=experiment_1")).ramp()
