"""The worked examples of docs/recordings.md: what a reader writes is what stands there, and the programs take it."""

from __future__ import annotations

import json
import re
import shlex
import shutil
from pathlib import Path

import pytest

from commands import environment
from doc_pages import FENCED, ROOT
from rod_recordings import write_recordings
from started import ran

PAGE = (ROOT / "docs" / "recordings.md").read_text(encoding="utf-8")
FILES = {
    match[1]: body
    for language, body in FENCED.findall(PAGE)
    if language == "yaml" and (match := re.match(r"# (\w+\.yaml)\n", body))
}
"""Name -> what stands in it."""
COMMANDS = [line for language, body in FENCED.findall(PAGE) if language == "bash" for line in body.splitlines()]
MOST = 20
"""Lines that a stranger has to write, at most: fewer."""


def written(folder: Path, *names: str) -> int:
    """Writes the files of an example, and counts their lines."""
    for name in names:
        (folder / name).write_text(FILES[name])
    return sum(1 for name in names for line in FILES[name].splitlines() if line and not line.startswith("#"))


def run(folder: Path, program: str, data: str, *more: str) -> Path:
    """Runs the page's command of a program on a data file; returns the folder of its results."""
    [line] = [line for line in COMMANDS if f"apcc_torch.{program} " in line and f"data={data}" in line]
    out = folder / program
    words = [*shlex.split(line)[3:], *more, "figures=false", f"hydra.run.dir={out}"]
    done = ran(f"apcc_torch.{program}", words, folder, environment())
    assert done.returncode == 0, done.stdout + done.stderr
    return out


def test_an_arm_of_ones_own(tmp_path: Path) -> None:
    pytest.importorskip("sklearn")
    write_recordings(tmp_path, count=40)
    assert written(tmp_path, "arm.yaml", "data.yaml") < MOST
    short = ("fit.steps=4", "fit.rounds=1", "fit.samples=24")
    chosen = "methods=[linear,'arm identified']"
    board = json.loads((run(tmp_path, "evaluate", "data.yaml", *short, chosen) / "table.json").read_text())
    assert not board["failures"] and "motors, load followed" in board["tasks"]
    fit = run(tmp_path, "identify", "data.yaml", *short, "online.samples=5", "progress=false")
    metrics = json.loads((fit / "metrics.json").read_text())
    assert metrics["fit_usable"] == 1.0 and metrics["arm_identified_tip_rmse_mm"] < 1.0
    replayed = json.loads((run(tmp_path, "simulate", "data.yaml", "progress=false") / "metrics.json").read_text())
    assert replayed["frames"] == 40 and replayed["sensor_error_linear_mean_mm"] < 1.0


def test_the_tpu_rod(shared_data: Path, tmp_path: Path) -> None:
    assert written(tmp_path, "rod_arm.yaml", "rod.yaml") < MOST
    shutil.copy(shared_data / "sorosim_statics" / "TPURod_statics.csv", tmp_path)
    out = run(tmp_path, "evaluate", "rod.yaml", "every=100")
    table = json.loads((out / "table.json").read_text())
    [methods] = table["tasks"].values()
    assert methods["plant=rod, plant.refine=6"]["sessions"]["shapes"]["body_2"]["rms_mm"] < 1.0


@pytest.mark.parametrize("name", FILES)
def test_every_file_of_the_page_is_of_an_example(name: str) -> None:
    assert name in ("arm.yaml", "data.yaml", "rod_arm.yaml", "rod.yaml")
