"""A sweep as a user types it: one folder a job, failures named, and the same numbers again."""

from __future__ import annotations

import json
import shlex
import subprocess
from pathlib import Path

import pytest
import yaml

from commands import ONE_BY_ONE, QUICK, jobs, metrics, simulate


@pytest.fixture(scope="module")
def swept(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, subprocess.CompletedProcess[str]]:
    """A sweep of four jobs of which one has a setting without meaning, into a folder given by a relative path."""
    cwd = tmp_path_factory.mktemp("swept")
    gains = "adaptation.gain_scale=0.1,1"
    done = simulate(
        cwd, "-m", ONE_BY_ONE, *QUICK, gains, "bounds.lower=0.5,1.5", "hydra.sweep.dir='a sweep'", "progress=true"
    )
    return cwd / "a sweep", done


def test_every_job_is_a_whole_folder_or_named(swept: tuple[Path, subprocess.CompletedProcess[str]]) -> None:
    folder, done = swept
    assert {path.name for path in folder.iterdir()} == {"0", "1.failed", "2", "3.failed", "multirun.yaml"}
    for name, gain in (("0", 0.1), ("2", 1)):
        written = {path.name for path in (folder / name).iterdir()}
        wanted = {
            "config.yaml",
            "metrics.json",
            "trajectory.npz",
            "versions.json",
            "simulate.log",
            "job.json",
            ".hydra",
        }
        assert written == wanted
        config = yaml.safe_load((folder / name / "config.yaml").read_text())
        assert config["adaptation"]["gain_scale"] == gain and config["bounds"]["lower"] == 0.5
        versions = json.loads((folder / name / "versions.json").read_text())
        assert {"seed": 0, "torch_threads": "1"}.items() <= versions.items() and "torch" in versions
        assert "end_effector_error_end_mm" in (folder / name / "simulate.log").read_text()
    assert done.returncode == 1
    told = done.stdout
    assert "4 jobs by BasicLauncher into" in told and "2 finished jobs in" in told
    why = "lower must be below upper for every section, got 1.5 and 1.4"
    for gain in ("0.1", "1"):
        assert f"adaptation.gain_scale={gain} bounds.lower=1.5: {why}" in told
    assert shlex.quote(f"hydra.sweep.dir='{folder}'") in told.partition("resume=true ")[2]
    assert "Traceback" not in told + done.stderr
    assert f"[ERROR] - {why}" in (folder / "1.failed" / "simulate.log").read_text()


def test_without_a_terminal_there_are_no_bars(swept: tuple[Path, subprocess.CompletedProcess[str]]) -> None:
    _, done = swept
    assert "|" not in done.stdout + done.stderr and "\r" not in done.stdout + done.stderr


def test_the_same_seed_and_settings_give_the_same_bits(
    swept: tuple[Path, subprocess.CompletedProcess[str]], tmp_path: Path
) -> None:
    folder, _ = swept
    job = ("adaptation.gain_scale=0.1", "bounds.lower=0.5")
    done = simulate(tmp_path, *QUICK, *job, "hydra.run.dir=run")
    assert done.returncode == 0, done.stderr
    assert metrics(tmp_path / "run") == metrics(folder / "0"), "a job of a sweep is that run, to the last bit"
    assert metrics(folder / "0") != metrics(folder / "2")


def test_a_sweep_is_not_begun_twice_by_accident(swept: tuple[Path, subprocess.CompletedProcess[str]]) -> None:
    folder, _ = swept
    before = jobs(folder)
    done = simulate(folder.parent, "-m", *QUICK, "seed=1,2", "hydra.sweep.dir='a sweep'")
    assert done.returncode == 2 and "resume=true runs only what is missing" in done.stdout
    assert jobs(folder) == before


def test_there_must_be_something_to_resume(tmp_path: Path) -> None:
    done = simulate(tmp_path, "-m", *QUICK, "seed=1,2", "resume=true")
    assert done.returncode == 2 and "resume=true needs hydra.sweep.dir=FOLDER" in done.stdout
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("word", "said"),
    [
        ("velocity_filter.window=5,wide", "velocity_filter.window must be a whole number, got 'wide'"),
        ("velocity_filter.window=5,0", "velocity_filter.window must be in"),
        ("velocity_filter.windw=5,15", "velocity_filter.windw is no setting; did you mean window?"),
        ("adaptation=none,normalised adaptation.rate=1,2", "adaptation.rate is read by nothing"),
    ],
)
def test_a_wrong_setting_of_one_job_ends_the_sweep_before_anything_runs(tmp_path: Path, word: str, said: str) -> None:
    done = simulate(tmp_path, "-m", *QUICK, *word.split(), "hydra.sweep.dir=s")
    told = done.stdout + done.stderr
    assert done.returncode == 2 and said in told and "Traceback" not in told
    assert not jobs(tmp_path / "s")


@pytest.mark.parametrize(
    ("draws", "said"),
    [
        ("choice(1,abc)", "controller.K must be a number, a list of numbers or [along, ...], got 'abc'"),
        ("interval(-1,2)", "controller.K must be positive and finite, got -1.0"),
    ],
)
def test_so_does_what_a_search_may_draw(tmp_path: Path, draws: str, said: str) -> None:
    pytest.importorskip("hydra_plugins.hydra_optuna_sweeper")
    done = simulate(tmp_path, *QUICK, "sweep=optuna_gains", f"controller.K={draws}", "hydra.sweep.dir=s")
    told = done.stdout + done.stderr
    assert done.returncode == 2 and said in told and "Traceback" not in told
    assert not jobs(tmp_path / "s")


def test_a_launcher_that_is_not_installed_is_named_with_its_extra(tmp_path: Path) -> None:
    own = tmp_path / "conf" / "hydra" / "launcher"
    own.mkdir(parents=True)
    (own / "far.yaml").write_text("_target_: hydra_plugins.hydra_colab_launcher.far.FarLauncher\n")
    done = simulate(tmp_path, "-cd", "conf", "-m", *QUICK, "seed=1,2", "hydra/launcher=far")
    assert done.returncode == 2
    assert done.stdout.strip().endswith("hydra_plugins.hydra_colab_launcher is not installed")
