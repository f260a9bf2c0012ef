"""Section V-B from settings to a folder: its metrics, its files, and the same seed twice."""

from __future__ import annotations

import json
import math
from pathlib import Path

import numpy as np
import pytest
import torch

from apcc_torch.errors import ApccError
from apcc_torch.experiments import dynamic
from apcc_torch.experiments.dynamic_metrics import dynamic_metrics, estimate_metrics
from apcc_torch.simulation.dynamic import DynamicLog
from composed import changed

QUICK = (
    *("experiment.duration=0.2", "controller.rate=50", "plant.substeps=2", "plant.settle=0.1"),
    *("figures=false", "progress=false"),
)
KEYS = {
    *("end_effector_error_end_mm", "end_effector_error_last5s_max_mm", "shape_error_mean_mm", "shape_error_max_mm"),
    *("shape_error_min_mm", "shape_error_end_mm", "shape_error_last5s_max_mm", "psi_mean_cm", "psi_max_cm"),
    *("sensor_error_linear_mean_mm", "sensor_error_angular_mean_rad", "pi_drift_end_max_mm", "rows", "diverged_rows"),
    "wall_s",
}


def run(folder: Path, *changes: str, experiment: str = "dynamic_single") -> dict[str, float]:
    return dynamic.run(changed(experiment, *QUICK, *changes), folder)


def test_folder_holds_what_was_returned(tmp_path: Path) -> None:
    metrics = run(tmp_path, "figures=true")
    assert set(metrics) >= KEYS and all(math.isfinite(value) for value in metrics.values())
    assert json.loads((tmp_path / "metrics.json").read_text()) == metrics
    names = {p.name for p in (tmp_path / "figures").iterdir()}
    pictures = ("shape_error", "psi", "parameters", "sensors", "end_effector", "mapping_error", "stroboscopic")
    assert names >= {f"{name}.png" for name in pictures}
    assert any(name.startswith("animation.") for name in names)
    with np.load(tmp_path / "trajectory.npz") as data:
        assert set(data) == set(DynamicLog._fields)
        assert data["q_true"].shape == (11, 1, 18) and data["y"].shape == (11, 1, 9)
        assert data["diverged_at"].tolist() == [-1]
        gap = 1e3 * np.linalg.norm(data["x_d"][-1] - data["x"][-1])
        assert metrics["end_effector_error_end_mm"] == pytest.approx(gap)


def test_the_same_seed_gives_the_same_numbers(tmp_path: Path) -> None:
    def numbers(seed: int, name: str) -> dict[str, float]:
        noise = ("sensors.position_noise=2e-4", "sensors.angular_noise=9e-3", "experiment.duration=0.06")
        metrics = run(tmp_path / name, *noise, f"seed={seed}")
        return {key: value for key, value in metrics.items() if key != "wall_s"}

    first = numbers(3, "a")
    assert first == numbers(3, "b")
    assert first["sensor_error_linear_mean_mm"] != numbers(4, "c")["sensor_error_linear_mean_mm"]


def test_the_grid_is_one_batch_and_the_standard_controller_keeps_its_parameters(tmp_path: Path) -> None:
    points = "experiment.setpoints=[[0.1,0,-0.5],[0,0.1,-0.5]]"
    metrics = run(tmp_path, points, "experiment.payloads=[0,0.25,0.5]", "controller.adaptive=false")
    assert metrics["rows"] == 6.0 and metrics["diverged_rows"] == 0.0 and metrics["pi_drift_end_max_mm"] == 0.0
    with np.load(tmp_path / "trajectory.npz") as data:
        assert data["x_d"][0].tolist() == [[0.1, 0.0, -0.5]] * 3 + [[0.0, 0.1, -0.5]] * 3
        assert float(data["x"][0, 2, 2]) < float(data["x"][0, 0, 2]), "the loaded arm hangs lower"


def test_tracking_follows_the_sine_with_every_payload(tmp_path: Path) -> None:
    metrics = run(tmp_path, "experiment.duration=0.06", experiment="tracking")
    assert metrics["rows"] == 3.0
    with np.load(tmp_path / "trajectory.npz") as data:
        np.testing.assert_allclose(data["x_d"][0], [[0.0, 0.0, -0.5]] * 3)


@pytest.mark.parametrize(("steps", "instants"), [(11, 4), (11, 100), (2, 1), (1001, 200)])
def test_thinned_keeps_the_last_instant_and_even_spacing(steps: int, instants: int) -> None:
    time = torch.arange(steps, dtype=torch.float64)
    log = DynamicLog(*[time] * (len(DynamicLog._fields) - 1), torch.tensor([-1]))
    kept = dynamic.thinned(log, instants)
    assert float(kept.time[-1]) == steps - 1 and len(kept.time) <= instants + 1
    assert len(set(kept.time.diff().tolist())) <= 1 and kept.diverged_at is log.diverged_at


def test_settling_time_is_that_of_the_last_crossing() -> None:
    # Errors of three runs over 0..4 s: settled after 2 s, never, at once.
    e = 1e-3 * torch.tensor([[50, 5, 50, 5, 5], [50, 50, 50, 50, 50], [5, 5, 5, 5, 5]], dtype=torch.float64).T
    flat, per_sensor = torch.zeros_like(e), torch.zeros(5, 3, 2, dtype=torch.float64)
    curves = dynamic.RunCurves(
        time=torch.arange(5, dtype=torch.float64),
        shape_error=torch.linspace(1e-3, 15e-3, 15, dtype=torch.float64).view(5, 3),
        psi=flat,
        angular=per_sensor,
        linear=per_sensor + torch.tensor([1e-3, 3e-3], dtype=torch.float64),
        e=e,
        pi_hat=torch.ones(5, 3, 3, dtype=torch.float64),
        mapping_error=flat,
        diverged=torch.tensor([0, 4, 0]).expand(5, 3),
    )
    metrics = dynamic_metrics(curves)
    assert metrics["settling_mean_s"] == pytest.approx((3 + 4 + 0) / 3)
    assert metrics["settled_share"] == pytest.approx(2 / 3)
    assert metrics["end_effector_error_end_mm"] == pytest.approx(20.0)
    assert metrics["end_effector_error_end_max_mm"] == pytest.approx(50.0)
    assert (metrics["shape_error_min_mm"], metrics["shape_error_max_mm"]) == pytest.approx((1.0, 15.0))
    assert metrics["shape_error_mean_mm"] == pytest.approx(8.0)
    assert metrics["shape_error_end_mm"] == pytest.approx(14.0)
    assert metrics["sensor_error_linear_mean_mm"] == pytest.approx(2.0)
    assert metrics["sensor_2_error_linear_mean_mm"] == pytest.approx(3.0)
    assert (metrics["rows"], metrics["diverged_rows"]) == (3.0, 1.0)


@pytest.mark.parametrize(
    ("change", "named"),
    [
        ("experiment.setpoints=[[0,0]]", "experiment.setpoints"),
        ("experiment.payloads=[-1]", "experiment.payloads"),
        ("plant.settle=-1", "plant.settle"),
        ("plant.pid.K_D=-5", "plant.pid.K_D"),
        ("experiment.duration=0", "duration"),
    ],
)
def test_a_setting_without_meaning_is_named_and_nothing_is_written(tmp_path: Path, change: str, named: str) -> None:
    with pytest.raises(ApccError, match=named):
        run(tmp_path, change)
    assert not list(tmp_path.iterdir())


def test_a_law_of_the_dynamics_is_logged_measured_and_drawn(tmp_path: Path) -> None:
    metrics = run(tmp_path, "figures=true", "experiment.payloads=[0.5]", experiment="dynamic_run_2_composite")
    with np.load(tmp_path / "trajectory.npz") as data:
        theta_hat, u = data["theta_hat"], data["u"]
    assert theta_hat.shape == (11, 10, 5) and theta_hat[0, 0].tolist() == [0.0778, 10.0, 200.0, 0.0, 1.0]
    off = 1e3 * np.abs(theta_hat[-1, :, 3] - 0.5)
    assert metrics["payload_mass_error_end_mean_g"] == pytest.approx(off.mean())
    assert metrics["payload_mass_error_end_max_g"] == pytest.approx(off.max())
    assert metrics["bending_rigidity_end_mean_nm2"] == pytest.approx(theta_hat[-1, :, 0].mean())
    assert metrics["tendon_force_max_n"] == pytest.approx(np.abs(u).max())
    assert (tmp_path / "figures" / "dynamics.png").stat().st_size > 0
    config = changed("dynamic_run_2_composite", *QUICK, "experiment.payloads=[0.5]")
    with np.load(tmp_path / "trajectory.npz") as data:
        again = dynamic.loaded(config, {name: torch.from_numpy(data[name]) for name in data})
        older = {name: torch.from_numpy(data[name]) for name in data if name != "theta_hat"}
    assert estimate_metrics(again.log, again.arms.theta)["payload_mass_error_end_max_g"] == pytest.approx(off.max())
    before = dynamic.loaded(config, older)
    assert estimate_metrics(before.log, before.arms.theta) == {}
