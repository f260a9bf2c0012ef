"""The simulate command as a user types it: its folder, its manual, and one sentence for what it cannot do."""

from __future__ import annotations

import json
import re
import subprocess
import sys
import zipfile
from pathlib import Path

import pytest

import commands
from apcc_torch.conf_path import conf_path
from apcc_torch.simulate import EXPERIMENTS
from started import ran

HELP_GROUPS = ("experiment", "state", "arm", "model", "plant", "sensors", "feedback", "pose_filter", "adaptation")
HELP_GROUPS += ("dynamics_law", "lookahead", "sweep", "hydra/launcher")


def simulate(folder: Path, *arguments: str) -> subprocess.CompletedProcess[str]:
    """Runs the command from an empty folder, with its results in `folder`/run."""
    return commands.simulate(folder, *arguments, f"hydra.run.dir={folder / 'run'}")


def test_a_run_leaves_a_whole_folder_and_says_where(tmp_path: Path) -> None:
    quick = ("experiment.duration=0.2", "controller.rate=50", "progress=false", "adaptation.gamma=20")
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
        (("experiment=kinematic", "controller.null_gian=3"), "did you mean null_gain?"),
        (("experiment=kinematic", "progres=false"), "did you mean progress?"),
        (("experiment=kinematic", "arm=nowhere.yaml"), "nowhere.yaml"),
        ((), "experiment"),
    ],
)
def test_a_wrong_or_missing_key_is_named_and_nothing_is_written(
    tmp_path: Path, arguments: tuple[str, ...], named: str
) -> None:
    done = simulate(tmp_path, *arguments)
    assert done.returncode != 0
    assert named in done.stderr and "Traceback" not in done.stderr
    assert not list(tmp_path.iterdir())


def test_help_is_the_manual(tmp_path: Path) -> None:
    done = simulate(tmp_path, "--help")
    assert done.returncode == 0, done.stderr
    for part in (
        "experiment ",
        "dynamic_run_2",
        "python -m apcc_torch.simulate",
        "hydra.run.dir",
        "gamma",
        "metrics.json",
    ):
        assert part in done.stdout, part
    assert not list(tmp_path.iterdir())
    # Every group of this program with every choice, and no other program's.
    manual = done.stdout.partition("What can be chosen")[2].partition("Examples:")[0]
    words = set(re.findall(r"[\w/]+", manual))
    for group in HELP_GROUPS:
        assert group in words
        names = {path.stem for path in (Path(conf_path()) / group).glob("*.yaml")}
        if group == "experiment":  # those of an arm in real time are not this program's
            names = set(EXPERIMENTS)
            assert not {"calibration", "experiment_1", "experiment_2"} & set(re.findall(r"^ +(\S+)", manual, re.M))
        assert names and names <= words, f"{group}: {names - words}"
    assert not {"grid", "guards", "hardware"} & set(re.findall(r"^\S+$", manual, re.MULTILINE))
    # Every choice with what the head of its file says, every key with unit, source and meaning.
    assert re.search(r"dynamic_run_1 +Section V-B, simulation run I: arm 1, positions only\n", done.stdout)
    keys = done.stdout.partition("set; ours 0.2]")[2]
    assert re.search(r"controller.K=1 1/s +\[paper\] task gain", keys)
    assert re.search(r"controller.null_gain=1 m/s +\[set; ours 0.2\] weight", keys)
    assert re.search(r"integral.reach=0.001 m +\[ours\] errors", keys)
    # What nothing reads with these choices is not among them, but told with its reason.
    assert "plant.arm.mass" not in keys and "experiment.setpoints=" not in keys
    assert re.search(r"plant, .*: experiment kinematic has no forces", " ".join(keys.split()))
    assert "guards." not in keys and "series." not in keys


def test_the_manual_shows_what_is_chosen(tmp_path: Path) -> None:
    for words in (("--help", "adaptation=none"), ("adaptation=none", "-h")):
        done = simulate(tmp_path, *words)
        assert done.returncode == 0 and "adaptation=null" in done.stdout, done.stderr


def test_the_shell_completes_names(tmp_path: Path) -> None:
    installed = commands.simulate(tmp_path, "-sc", "install=bash")
    assert installed.returncode == 0 and "complete " in installed.stdout, installed.stderr
    for line, wanted in {
        "apcc-simulate experiment=dyn": {"experiment=dynamic_run_1", "experiment=dynamic_run_2"},
        "apcc-simulate sweep=": {"sweep=gains_and_window", "sweep=optuna_gains"},
        "apcc-simulate experiment=kinematic controller.n": {"controller.null_step=", "controller.null_gain="},
    }.items():
        env = commands.environment() | {"COMP_LINE": line, "COMP_POINT": str(len(line))}
        done = ran("apcc_torch.simulate", ["-sc", "query=bash"], tmp_path, env)
        assert wanted <= set(done.stdout.split()), done.stdout + done.stderr


OWN = """# @package _global_
defaults:
  - kinematic
  - _self_
adaptation:
  gamma: 33.0
experiment:
  name: mine
  duration: 0.1
"""


@pytest.fixture(params=["checkout", "wheel"])
def package(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Where the package is imported from: the checkout, or an unpacked wheel of it."""
    if request.param == "checkout":
        return commands.ROOT
    builder = pytest.importorskip("hatchling.builders.wheel").WheelBuilder(str(commands.ROOT))
    folder = tmp_path_factory.mktemp("wheel")
    wheel = next(builder.build(directory=str(folder), versions=["standard"]))
    zipfile.ZipFile(wheel).extractall(folder / "installed")
    return folder / "installed"


def test_a_folder_of_ones_own_adds_configurations(package: Path, tmp_path: Path) -> None:
    (tmp_path / "own" / "experiment").mkdir(parents=True)
    (tmp_path / "own" / "experiment" / "mine.yaml").write_text(OWN)
    arguments = ("-cd", "own", "experiment=mine", "figures=false", "controller.rate=50", "hydra.run.dir=run")
    done = commands.simulate(tmp_path, *arguments, package=package)
    assert done.returncode == 0, done.stderr
    config = (tmp_path / "run" / "config.yaml").read_text()
    assert "name: mine" in config and "gamma: 33.0" in config
    where = [sys.executable, "-c", "import apcc_torch; print(apcc_torch.__file__)"]
    found = subprocess.run(where, cwd=tmp_path, env=commands.environment(package), capture_output=True, text=True)
    assert Path(found.stdout.strip()).is_relative_to(package), "another package was tried"
