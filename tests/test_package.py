"""The package as a user gets it: its version, its public names, its programs, and what the wheel holds."""

from __future__ import annotations

import importlib
import importlib.metadata
import os
import re
import subprocess
import sys
import tomllib
import zipfile
from pathlib import Path
from typing import Any

import pytest
from matplotlib.image import imread

import apcc_torch
from apcc_torch import conf_path
from apcc_torch.errors import ConfigError

ROOT = Path(__file__).resolve().parents[1]
PROJECT: dict[str, Any] = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]

PUBLIC_NAMES = (
    "APCCController",
    "AdaptiveLaw",
    "Arm",
    "InverseKinematics",
    "PCCBackbone",
    "SavitzkyGolay",
    "SoftArmDynamics",
    "StateFeedback",
    "TendonRouting",
    "compose",
    "decouple",
    "shape_error",
)


def test_version_is_the_projects() -> None:
    assert apcc_torch.__version__ == PROJECT["version"]


def test_version_is_the_installed_one() -> None:
    try:
        installed = importlib.metadata.version(PROJECT["name"])
    except importlib.metadata.PackageNotFoundError:
        pytest.skip("run from a checkout that is not installed")
    assert installed == apcc_torch.__version__


@pytest.mark.parametrize("name", PUBLIC_NAMES)
def test_public_name(name: str) -> None:
    assert callable(getattr(apcc_torch, name))
    assert name in apcc_torch.__all__


def test_all_names_exist() -> None:
    missing = [name for name in apcc_torch.__all__ if not hasattr(apcc_torch, name)]
    assert not missing


@pytest.mark.parametrize("script", PROJECT["scripts"])
def test_console_script_resolves(script: str) -> None:
    module, _, attribute = PROJECT["scripts"][script].partition(":")
    assert callable(getattr(importlib.import_module(module), attribute))


def test_extras_of_the_project_are_its_own() -> None:
    extras = PROJECT["optional-dependencies"]

    def named(extra: str) -> set[str]:
        own = [line for line in extras[extra] if line.startswith(PROJECT["name"] + "[")]
        return {name for line in own for name in line.partition("[")[2].rstrip("]").split(",")}

    # The first command of the README installs only dev, and its figures need viz, which report brings.
    assert named("dev") == {"feetech", "hardware", "log", "modbus", "qp", "report", "rl"} and named("report") == {"viz"}
    assert named("dev") | named("report") <= set(extras)


def test_conf_path_is_absolute_and_holds_configs() -> None:
    folder = Path(conf_path.conf_path())
    assert folder.is_absolute()
    assert any(folder.rglob("*.yaml"))


def test_conf_path_says_where_it_looked(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setattr(conf_path, "_PACKAGE", tmp_path / "apcc_torch")
    with pytest.raises(ConfigError, match="no configurations found"):
        conf_path.conf_path()


def test_conf_path_prefers_the_packages_own(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setattr(conf_path, "_PACKAGE", tmp_path / "apcc_torch")
    (tmp_path / "conf").mkdir()
    assert conf_path.conf_path() == str(tmp_path / "conf")
    (tmp_path / "apcc_torch" / "conf").mkdir(parents=True)
    assert conf_path.conf_path() == str(tmp_path / "apcc_torch" / "conf")


@pytest.fixture(scope="module")
def wheel(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The project's wheel, built in this process from the checkout."""
    builder = pytest.importorskip("hatchling.builders.wheel").WheelBuilder(str(ROOT))
    folder = tmp_path_factory.mktemp("wheel")
    return Path(next(builder.build(directory=str(folder), versions=["standard"])))


def test_wheel_holds_the_package_and_its_configs(wheel: Path) -> None:
    names = set(zipfile.ZipFile(wheel).namelist())
    package = {path.relative_to(ROOT).as_posix() for path in (ROOT / "apcc_torch").rglob("*.py")}
    configs = {f"apcc_torch/{path.relative_to(ROOT).as_posix()}" for path in (ROOT / "conf").rglob("*.yaml")}
    assert configs
    assert package | configs | {"apcc_torch/py.typed"} <= names
    tops = {name.partition("/")[0] for name in names if ".dist-info/" not in name}
    assert tops == {"apcc_torch"}, "the wheel must hold nothing beside the package"
    assert any(name.endswith(".dist-info/licenses/LICENSE") for name in names)


@pytest.fixture(scope="module")
def installed(wheel: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The wheel installed into a folder of its own; what it needs is there already."""
    folder = tmp_path_factory.mktemp("installed")
    pip = [sys.executable, "-m", "pip", "install", "-q", "--no-deps", "--no-index", "--no-compile"]
    subprocess.run([*pip, "--target", str(folder), str(wheel)], check=True, capture_output=True)
    return folder


def started_from(folder: Path, cwd: Path, *command: str) -> str:
    """What a Python command prints that finds the package in `folder` alone."""
    env = os.environ | {"PYTHONPATH": str(folder)}
    done = subprocess.run([sys.executable, *command], env=env, cwd=cwd, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    return done.stdout


def test_wheel_finds_its_own_configs(installed: Path, tmp_path: Path) -> None:
    code = (
        "import apcc_torch; from apcc_torch.conf_path import conf_path; print(conf_path());"
        "print(apcc_torch.compose('experiment=dynamic_run_2').settings.experiment.duration)"
    )
    folder, duration = started_from(installed, tmp_path, "-c", code).split()
    assert Path(folder).resolve() == (installed / "apcc_torch" / "conf").resolve()
    assert float(duration) == 10.0


def test_demo_runs_from_the_wheel(installed: Path, tmp_path: Path) -> None:
    told = started_from(installed, tmp_path, str(installed / "bin" / "apcc-demo"))
    lengths, tip = (float(number) for number in re.findall(r"within ([\d.]+) mm", told))
    assert lengths < 5.0 and tip < 1.0
    assert imread(tmp_path / "runs" / "demo" / "demo.png").std() > 0.05
    assert told.count("python -m apcc_torch.") == 3
