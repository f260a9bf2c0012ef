"""The programs as a user starts them: from an empty folder, as if installed."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import apcc_torch
from started import ran

ROOT = Path(apcc_torch.__file__).resolve().parents[1]

QUICK = ("experiment=kinematic", "experiment.duration=0.1", "controller.rate=50", "figures=false")
"""A run of a few steps."""


ONE_BY_ONE = "hydra/launcher=basic"


def environment(package: Path = ROOT) -> dict[str, str]:
    """Of a process that finds the package in `package`."""
    env = os.environ | {"PYTHONPATH": os.pathsep.join([str(package), os.environ.get("PYTHONPATH", "")])}
    env.pop("HYDRA_FULL_ERROR", None)
    return env


def command(*arguments: str) -> list[str]:
    """The simulate command."""
    return [sys.executable, "-m", "apcc_torch.simulate", *arguments]


def simulate(cwd: Path, *arguments: str, package: Path = ROOT, forked: bool = True) -> subprocess.CompletedProcess[str]:
    """Runs the simulate command from the folder `cwd`, which is made; see `started` for what is forked."""
    cwd.mkdir(parents=True, exist_ok=True)
    if forked and package == ROOT:
        return ran("apcc_torch.simulate", [*arguments], cwd, environment())
    return subprocess.run(
        command(*arguments), cwd=cwd, env=environment(package), capture_output=True, text=True, check=False, timeout=300
    )


def example(name: str, *options: str) -> list[str]:
    """The lines that `python examples/NAME --quick` prints."""
    done = ran(str(ROOT / "examples" / name), ["--quick", *options], ROOT, environment())
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout.splitlines()


def metrics(folder: Path) -> dict[str, float]:
    """Metrics of a run but the time it took, which alone may differ."""
    found: dict[str, float] = json.loads((folder / "metrics.json").read_text())
    assert found.pop("wall_s") > 0
    return found


def jobs(sweep: Path) -> dict[str, dict[str, float]]:
    """Metrics of a sweep's finished jobs, by what was swept; each once."""
    found: dict[str, dict[str, float]] = {}
    for record in sweep.glob("*/job.json"):
        job = json.loads(record.read_text())
        name = " ".join(
            o for o in job["overrides"] if o.split("=")[0] not in ("resume", *(q.split("=")[0] for q in QUICK))
        )
        assert name not in found, f"{name} is there twice"
        found[name] = metrics(record.parent)
    return found


def children(pid: int) -> list[int]:
    """The processes that a process began, and that run."""
    found = []
    for stat in Path("/proc").glob("[0-9]*/stat"):
        try:
            state, parent = stat.read_text().rpartition(")")[2].split()[:2]
        except (OSError, ValueError):
            continue  # it has just ended
        if int(parent) == pid and state != "Z":
            found.append(int(stat.parent.name))
    return found


def descendants(pid: int) -> list[int]:
    """The same, and theirs."""
    return [each for child in children(pid) for each in (child, *descendants(child))]
