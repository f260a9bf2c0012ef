"""The simulate command as a user types it: its folder, its manual, and one sentence for what it cannot do."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

import apcc_torch

ROOT = Path(apcc_torch.__file__).resolve().parents[1]


def simulate(folder: Path, *arguments: str) -> subprocess.CompletedProcess[str]:
    """Runs the command from an empty folder, as if installed, with its results in `folder`/run."""
    folder.mkdir(parents=True, exist_ok=True)
    env = os.environ | {"PYTHONPATH": os.pathsep.join([str(ROOT), os.environ.get("PYTHONPATH", "")])}
    env.pop("HYDRA_FULL_ERROR", None)
    command = [sys.executable, "-m", "apcc_torch.simulate", *arguments, f"hydra.run.dir={folder / 'run'}"]
    return subprocess.run(command, cwd=folder, env=env, capture_output=True, text=True, check=False, timeout=300)


def test_a_run_leaves_a_whole_folder_and_says_where(tmp_path: Path) -> None:
    quick = ("experiment.duration=0.2", "controller.rate=50", "progress=false", "controller.gamma=20")
    done = simulate(tmp_path, "experiment=kinematic", *quick)
    assert done.returncode == 0, done.stderr
    run = tmp_path / "run"
    written = {path.relative_to(run).as_posix() for path in run.rglob("*") if path.is_file()}
    wanted = {"config.yaml", "metrics.json", "trajectory.npz", "versions.json", "simulate.log"}
    assert written >= wanted | {f"figures/figure_{k}.png" for k in (7, 8, 9)}
    assert not [name for name in written if "draft" in name]
    assert [path.name for path in tmp_path.iterdir()] == ["run"], "nothing is left outside the run's folder"
    metrics = json.loads((run / "metrics.json").read_text())
    assert metrics["rows"] == 1.0 and metrics["wall_s"] > 0
    # The settings are the resolved ones, whatever they came from.
    config = (run / "config.yaml").read_text()
    assert "gamma: 20" in config and "rate: 50" in config and "${" not in config
    told = done.stdout + done.stderr
    assert str(run) in told and "end_effector_error_end_mm" in told and "Traceback" not in told
    assert "end_effector_error_end_mm" in (run / "simulate.log").read_text()


def test_a_setting_without_meaning_ends_with_one_sentence(tmp_path: Path) -> None:
    done = simulate(tmp_path, "experiment=kinematic", "dtype=float16")
    assert done.returncode == 2
    told = done.stdout + done.stderr
    assert "dtype must be one of float64, float32, got 'float16'" in told and "Traceback" not in told
    assert len(told.strip().splitlines()) == 1, told
    assert not (tmp_path / "run" / "metrics.json").exists()


@pytest.mark.parametrize(
    ("arguments", "named"),
    [
        (("experiment=kinematic", "controller.gama=3"), "gama"),
        ((), "experiment"),
    ],
)
def test_a_wrong_or_missing_key_is_named_and_nothing_is_written(
    tmp_path: Path, arguments: tuple[str, ...], named: str
) -> None:
    done = simulate(tmp_path, *arguments)
    assert done.returncode not in (0, 2)
    assert named in done.stderr and "Traceback" not in done.stderr
    assert not list(tmp_path.iterdir())


def test_help_is_the_manual(tmp_path: Path) -> None:
    done = simulate(tmp_path, "--help")
    assert done.returncode == 0, done.stderr
    for part in ("experiment:", "dynamic_run_2", "python -m apcc_torch.simulate", "hydra.run.dir", "gamma"):
        assert part in done.stdout, part
    assert not list(tmp_path.iterdir())
