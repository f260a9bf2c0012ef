"""Section V-A from settings to a folder: its metrics, its files, and the same seed twice."""

from __future__ import annotations

import json
import math
from pathlib import Path

import numpy as np
import pytest
import torch

from apcc_torch.composition.stacking import stacked
from apcc_torch.control.controller import APCCController
from apcc_torch.errors import ApccError
from apcc_torch.experiments import kinematic
from apcc_torch.model.arm import Arm
from apcc_torch.model.backbone import PCCBackbone
from apcc_torch.simulation.divergence import Divergence
from apcc_torch.simulation.kinematic import KinematicLog
from arms import HANGING_BASE, PI
from composed import changed

QUICK = ("experiment.duration=0.2", "controller.rate=50", "figures=false", "progress=false")
KEYS = {
    *("end_effector_error_end_mm", "end_effector_error_last5s_max_mm", "shape_error_mean_mm", "shape_error_max_mm"),
    *("shape_error_min_mm", "shape_error_end_mm", "shape_error_last5s_max_mm", "psi_mean_cm", "psi_max_cm"),
    *("sensor_error_linear_mean_mm", "sensor_error_angular_mean_rad", "pi_error_end_max_mm", "rows", "diverged_rows"),
    "wall_s",
}


def run(folder: Path, *changes: str) -> dict[str, float]:
    return kinematic.run(changed("kinematic", *QUICK, *changes), folder)


@pytest.mark.parametrize("state", ["feedback", "exact"])
def test_folder_holds_what_was_returned(tmp_path: Path, state: str) -> None:
    metrics = run(tmp_path, f"state={state}", f"experiment.first_estimate={[0.11 / 0.105, 0.26 / 0.255, 0.25 / 0.24]}")
    assert set(metrics) >= KEYS and all(math.isfinite(value) for value in metrics.values())
    assert json.loads((tmp_path / "metrics.json").read_text()) == metrics
    assert sorted(p.name for p in tmp_path.iterdir()) == ["metrics.json", "trajectory.npz", "versions.json"]
    versions = json.loads((tmp_path / "versions.json").read_text())
    assert versions["torch"] == torch.__version__ and versions["seed"] == 0
    with np.load(tmp_path / "trajectory.npz") as data:
        assert set(data) == {*KinematicLog._fields, "pi"}
        assert data["time"].shape == (11,) and data["q_true"].shape == (11, 1, 9)
        assert data["pi"].tolist() == [0.105, 0.255, 0.24]
        np.testing.assert_allclose(data["pi_hat"][0, 0], [0.11, 0.26, 0.25])
        end = 1e3 * np.linalg.norm(data["x_d"][-1] - data["x"][-1])
        assert metrics["end_effector_error_end_mm"] == pytest.approx(end)
        assert metrics["pi_error_end_max_mm"] == pytest.approx(1e3 * np.abs(data["pi_hat"][-1] - data["pi"]).max())


def test_the_same_seed_gives_the_same_numbers(tmp_path: Path) -> None:
    def numbers(seed: int, name: str) -> dict[str, float]:
        metrics = run(tmp_path / name, "experiment.start_errors=2", f"seed={seed}")
        return {key: value for key, value in metrics.items() if key != "wall_s"}

    first, again, other = numbers(3, "a"), numbers(3, "b"), numbers(4, "c")
    assert first == again
    assert first["rows"] == 3.0 and first["all_rows_pi_error_end_max_mm"] != other["all_rows_pi_error_end_max_mm"]
    # Row 0 is no random one.
    assert first["pi_error_end_max_mm"] == other["pi_error_end_max_mm"]
    with np.load(tmp_path / "a" / "trajectory.npz") as data:
        starts = data["pi_hat"][0, 1:] / data["pi"]
        assert starts.shape == (2, 3) and np.abs(starts - 1).max() <= 0.15


def test_the_window_the_noise_and_the_gain_count() -> None:
    """Short, slow and noisy: what the law makes of the velocity depends on N and on Gamma."""
    base = ("experiment.duration=4", "controller.rate=50", "progress=false", "sensors.angular_noise=0.008726646")
    changes = ["velocity_filter.window=5", "velocity_filter.window=15", "velocity_filter.window=45"]
    changes.append("adaptation.gain_scale=0.1")
    configs = [changed("kinematic", *base, change) for change in changes]
    outcome = kinematic.simulate(stacked(configs), len(configs))
    found = [kinematic.metrics(kinematic.one_of(outcome, config, p)) for p, config in enumerate(configs)]
    lengths = [tuple(row[f"pi_hat_{i}_end_m"] for i in (1, 2, 3)) for row in found]
    assert len(set(lengths)) == 4
    noise = [row["velocity_noise_mmps"] for row in found[:3]]
    assert noise[0] > 2.0 * noise[1] > 2.0 * noise[2] > 0.0


def test_rounding_is_not_amplified() -> None:
    """Alone, beside others, and moved by 1e-12: the same to 1e-9."""
    base = ("experiment.duration=2", "controller.rate=100", "progress=false")
    moved = ("experiment.r_0=[1e-12,0.0,-0.5]", "controller.K=1.000000000001", "controller.null_gain=1.000000000001")
    configs = [changed("kinematic", *base, *(() if not change else (change,))) for change in ("", *moved)]
    outcome = kinematic.simulate(stacked(configs), len(configs))
    alone = kinematic.metrics(kinematic.simulate(configs[0]))
    for p, config in enumerate(configs):
        beside = kinematic.metrics(kinematic.one_of(outcome, config, p))
        assert beside == pytest.approx(alone, rel=1e-9, abs=1e-9)
    assert float(outcome.log.pi_hat[-1].sum(-1).min()) < 0.6 + 1e-9, "the bound that rounding decides is reached"


def test_perfect_knowledge_leaves_no_shape_error(tmp_path: Path) -> None:
    metrics = run(
        tmp_path, "experiment.first_estimate=1.0", "controller.adaptive=false", "feedback.linear_threshold=1e-9"
    )
    assert metrics["shape_error_max_mm"] < 1e-3 and metrics["pi_error_end_max_mm"] == 0.0


def test_metrics_by_hand() -> None:
    # Two rows over three instants: on the straight arm, but for one elongation and one missed target.
    zero = torch.zeros(3, 2, 9, dtype=torch.float64)
    backbone = PCCBackbone(3, HANGING_BASE)
    x = backbone.tip(zero, PI)
    x_d = x.clone()
    x_d[-1, 1, 0] += 0.004
    q_bar = zero.clone()
    q_bar[1, 0, 2::3] = torch.tensor([0.003, 0.0, 0.004], dtype=torch.float64)
    errors = torch.tensor([0.002, 0.001], dtype=torch.float64).expand(3, 2, 2)
    pi_hat = (PI + torch.tensor([0.0, 0.003, -0.005], dtype=torch.float64)).expand(3, 2, 3)
    time, status = torch.arange(3, dtype=torch.float64), torch.zeros(3, 2, dtype=torch.int64)
    log = KinematicLog(time, x_d, x, zero, q_bar, zero, pi_hat, errors, errors, status)
    controller = APCCController.for_arm(Arm(lengths=PI.tolist()))
    outcome = kinematic.Outcome(log, PI, controller, Divergence())
    metrics = kinematic.kinematic_metrics(outcome)
    assert metrics["end_effector_error_end_max_mm"] == metrics["end_effector_error_last5s_max_mm"] == pytest.approx(4.0)
    assert metrics["end_effector_error_end_mm"] == pytest.approx(2.0)
    assert metrics["end_effector_error_mean_mm"] == pytest.approx(4.0 / 6)
    assert metrics["psi_max_cm"] == pytest.approx(0.5) and metrics["psi_mean_cm"] == pytest.approx(0.5 / 6)
    assert metrics["sensor_error_linear_mean_mm"] == pytest.approx(1.5)
    assert metrics["sensor_error_angular_mean_rad"] == pytest.approx(0.0015)
    assert metrics["pi_error_end_max_mm"] == pytest.approx(5.0)
    # Two straight arms, 2 mm apart at their tips and evenly less towards the base: 1 mm on average.
    assert metrics["shape_error_end_mm"] == pytest.approx(1.0) == metrics["shape_error_min_mm"]
    # The elongated one, 605 mm in all, is 5 mm longer than the true arm.
    assert metrics["shape_error_max_mm"] == pytest.approx(2.5)
    assert (metrics["rows"], metrics["diverged_rows"]) == (2.0, 0.0)
    lost = log._replace(x_d=x_d + torch.tensor([0.0, 1.0], dtype=torch.float64).view(2, 1))
    assert kinematic.kinematic_metrics(outcome._replace(log=lost))["diverged_rows"] == 1.0


def test_a_run_that_runs_away_says_so_and_keeps_its_numbers(
    tmp_path: Path, caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    # One sensor at the tip of three sections: what it measures leaves open how long each of them is.
    config = changed("kinematic", *QUICK, "arm.sensors=[0.6]", "experiment.duration=2.0", "controller.rate=100")
    metrics = kinematic.run(config, tmp_path)
    assert metrics["diverged_rows"] == 1.0
    assert "1 of 1 rows diverged: row 0 from" in caplog.text and "elongation" in caplog.text
    assert json.loads((tmp_path / "metrics.json").read_text())["diverged_rows"] == 1.0
    with np.load(tmp_path / "trajectory.npz") as data:
        arrays = {name: torch.from_numpy(data[name]) for name in data}
    marks: list[str] = []
    monkeypatch.setattr(kinematic, "save_animation", lambda *film, warning, **how: marks.append(warning))
    kinematic.redraw(config, arrays, tmp_path, False, True)
    assert len(marks) == 1 and marks[0].startswith("1 of 1 rows diverged: row 0 from")


@pytest.mark.parametrize(
    "change",
    ["state=guessed", "experiment.start_errors=-1", "experiment.start_error=1.5", "experiment.r_0=null"],
)
def test_a_setting_without_meaning_is_named_and_nothing_is_written(tmp_path: Path, change: str) -> None:
    with pytest.raises(ApccError, match=change.split("=")[0]):
        run(tmp_path, change)
    assert not list(tmp_path.iterdir())
