"""Every launcher gives the same numbers, each where its plugin is installed."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

from commands import ONE_BY_ONE, QUICK, environment, jobs, simulate
from started import ran

RAY = {"RAY_worker_niceness": "0"}
"""Ray gives way to all else, by a niceness of 15: beside other busy tests its jobs would stand for minutes."""

SWEEP = ("-m", *QUICK, "velocity_filter.window=5,15", "hydra.sweep.dir=sweep")


@pytest.fixture(scope="module")
def wanted(tmp_path_factory: pytest.TempPathFactory) -> dict[str, dict[str, float]]:
    """The numbers of the basic launcher."""
    cwd = tmp_path_factory.mktemp("basic")
    done = simulate(cwd, *SWEEP, ONE_BY_ONE)
    assert done.returncode == 0, done.stdout + done.stderr
    found = jobs(cwd / "sweep")
    assert set(found) == {"velocity_filter.window=5", "velocity_filter.window=15"}
    return found


def same(found: dict[str, dict[str, float]], wanted: dict[str, dict[str, float]]) -> None:
    assert set(found) == set(wanted)
    for job, numbers in wanted.items():
        assert found[job] == pytest.approx(numbers, rel=1e-9, abs=1e-12, nan_ok=True)


@pytest.mark.parametrize(
    ("launcher", "plugin"),
    [
        ("joblib", "hydra_joblib_launcher"),
        ("submitit_local", "hydra_submitit_launcher"),
        ("ray_local", "hydra_ray_launcher"),
    ],
)
def test_a_launcher_of_this_machine(
    launcher: str,
    plugin: str,
    tmp_path: Path,
    wanted: dict[str, dict[str, float]],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    pytest.importorskip(f"hydra_plugins.{plugin}")
    for name, value in RAY.items():
        monkeypatch.setenv(name, value)
    # Launchers start processes of their own kinds: from one as a user has it.
    done = simulate(tmp_path, *SWEEP, f"hydra/launcher={launcher}", forked=False)
    assert done.returncode == 0, done.stdout + done.stderr
    same(jobs(tmp_path / "sweep"), wanted)
    assert "is validated against ConfigStore schema" not in done.stderr


CLUSTER = """
import subprocess, sys, ray
from ray.cluster_utils import Cluster
cluster = Cluster(initialize_head=True, head_node_args={"num_cpus": 1, "include_dashboard": False})
cluster.add_node(num_cpus=1)
cluster.wait_for_nodes()
try:
    address = f"hydra.launcher.ray.init.address={cluster.address}"
    command = [sys.executable, "-m", "apcc_torch.simulate", *sys.argv[1:], address]
    sys.exit(subprocess.run(command).returncode)
finally:
    cluster.shutdown()
"""


def test_a_running_ray_cluster_of_two_nodes(tmp_path: Path, wanted: dict[str, dict[str, float]]) -> None:
    pytest.importorskip("hydra_plugins.hydra_ray_launcher")
    pytest.importorskip("ray.cluster_utils")
    done = subprocess.run(
        [sys.executable, "-c", CLUSTER, *SWEEP, "hydra/launcher=ray_cluster"],
        cwd=tmp_path,
        env=environment() | RAY,
        capture_output=True,
        text=True,
        check=False,
        timeout=400,
    )
    assert done.returncode == 0, done.stdout + done.stderr
    same(jobs(tmp_path / "sweep"), wanted)


def test_the_slurm_launcher_asks_for_what_its_config_says(tmp_path: Path) -> None:
    pytest.importorskip("hydra_plugins.hydra_submitit_launcher")
    # A cluster in name only: it notes what it is asked, and takes the job.
    tools = tmp_path / "bin"
    tools.mkdir()
    for name, script in {
        "sbatch": f'cp "$1" {tmp_path}/asked.sh; echo "Submitted batch job 7"',
        "srun": "exit 0",
        "sacct": 'echo "JobID|State|NodeList"; echo "7_0|FAILED|"; echo "7_1|FAILED|"; echo "7|FAILED|"',
        "scontrol": "exit 0",
    }.items():
        (tools / name).write_text(f"#!/bin/sh\n{script}\n")
        (tools / name).chmod(0o755)
    wanted_of_slurm = (
        "hydra.launcher.partition=short",
        "hydra.launcher.mem_gb=3",
        "hydra.launcher.array_parallelism=2",
    )
    env = environment() | {"PATH": f"{tools}{os.pathsep}{os.environ['PATH']}"}
    done = ran("apcc_torch.simulate", [*SWEEP, "hydra/launcher=submitit_slurm", *wanted_of_slurm], tmp_path, env)
    asked = (tmp_path / "asked.sh").read_text()
    for line in (
        "--array=0-1%2",
        "--partition=short",
        "--mem=3GB",
        "--time=60",
        "--cpus-per-task=1",
        "job-name=simulate",
    ):
        assert line in asked, asked
    assert done.returncode == 1 and "velocity_filter.window=15" in done.stdout, done.stdout + done.stderr
