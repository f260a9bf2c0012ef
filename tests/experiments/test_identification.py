"""python -m apcc_torch.identify as a user runs it, and what it reaches on real recordings."""

from __future__ import annotations

import json
import math
import subprocess
from pathlib import Path

import numpy as np
import pytest
import torch

from apcc_torch.composition import identify as composition
from apcc_torch.experiments.identification import Task, compare, error, identified
from apcc_torch.experiments.identification_report import why_not
from apcc_torch.identification.intervals import coverage, half_widths
from apcc_torch.identification.split import thinned
from apcc_torch.identification.tendon_arm import TendonArm
from apcc_torch.model.arm import Arm
from commands import environment
from composed import composed_identify
from identified_arms import FIT, FITTED, READ, parameters, write_recording
from started import ran


def _identify(folder: Path, *arguments: str) -> subprocess.CompletedProcess[str]:
    return ran("apcc_torch.identify", [*arguments], folder, environment())


def test_a_recording_of_ones_own_from_the_command_line(tmp_path: Path) -> None:
    path = write_recording(tmp_path)
    done = _identify(tmp_path, "arm=small.yaml", f"data={path}", *READ, *FIT, "hydra.run.dir=out")
    assert done.returncode == 0, done.stdout + done.stderr
    out = tmp_path / "out"
    metrics = json.loads((out / "metrics.json").read_text())
    # White noise of 0.1 mm a coordinate leaves 0.17 mm of distance.
    assert metrics["arm_identified_tip_rmse_mm"] == pytest.approx(0.173, rel=0.25)
    assert metrics["linear_tip_rmse_mm"] > 20 * metrics["arm_identified_tip_rmse_mm"]
    assert metrics["arm_length_mm"] == pytest.approx(200.0)
    assert metrics["interval_disagreement"] < 2.0

    arrays = np.load(out / "trajectory.npz")
    assert arrays["held_back"].sum() == metrics["validation_samples"] == 40
    held = arrays["held_back"]
    off = np.abs(arrays["measured"] - arrays["arm_identified"])[held]
    for body in (0, 1):
        share = 100.0 * (off[:, body] <= arrays["half_width"][held][:, body]).mean()
        assert metrics[f"arm_identified_body_{body + 1}_coverage_percent"] == pytest.approx(share)
        assert 88.0 < share <= 100.0  # 120 coordinates of white noise
        assert metrics[f"arm_identified_body_{body + 1}_half_width_mm"] == pytest.approx(0.2, rel=0.25)
    assert np.isnan(arrays["half_width"][~held]).all()
    assert metrics["training_samples_linear"] == 120 and metrics["training_samples_fit"] == 100

    told = json.loads((out / "parameters.json").read_text())
    entries = {p["name"]: p for p in told["parameters"]}
    assert told["usable"] and metrics["fit_usable"] == 1.0 and "Do not use" not in (out / "table.txt").read_text()
    truth = parameters(**FITTED)
    values = truth.values(torch.linspace(-0.8, 0.9, len(truth), dtype=torch.float64))
    inside = [
        entries[f"{name}: {label}"]["low"] <= float(values[name][i]) <= entries[f"{name}: {label}"]["high"]
        for name in FITTED
        for i, label in enumerate(truth.blocks[name].labels)
    ]
    assert sum(inside) >= len(inside) - 3
    table = (out / "table.txt").read_text()
    assert "linear regression, all training samples" in table and "known no better" in table
    assert {p.name for p in (out / "figures").iterdir()} == {
        *("models.png", "prediction.png", "residual.png", "parameters.png")
    }

    text = (out / "arm.yaml").read_text()
    assert text.startswith(f"# small, from {path} by python -m apcc_torch.identify")
    result = Arm.load(out / "arm.yaml")
    assert result.bending_rigidity == pytest.approx(values["bending_rigidity"].tolist(), rel=0.05)
    assert result.lengths == (0.1, 0.1)
    assert Arm.load(out / "parameters.json") == result

    # What was identified is as good a start as any arm's file: it is already at rest where the recording is.
    short = ("fit.steps=1", "fit.rounds=1", "fit.samples=24", "online.samples=5", "figures=false")
    again = _identify(tmp_path, "arm=out/parameters.json", f"data={path}", *READ, *FIT, *short, "hydra.run.dir=again")
    assert again.returncode == 0, again.stdout + again.stderr
    there = json.loads((tmp_path / "again" / "metrics.json").read_text())
    assert there["arm_identified_tip_rmse_mm"] == pytest.approx(metrics["arm_identified_tip_rmse_mm"], rel=0.1)


def test_wrong_files_end_in_one_sentence(tmp_path: Path) -> None:
    done = _identify(tmp_path, "data=nothing.csv")
    assert done.returncode == 2
    assert done.stderr.strip() == "apcc_torch.identify: nothing.csv: there is no such file or folder"
    bad = tmp_path / "bad.csv"
    bad.write_text("timestamp,servo_1_mm,tip_x\n1,2,3\n")
    done = _identify(tmp_path, f"data={bad}", "hydra.run.dir=out")
    assert done.returncode == 2
    assert "column 'tip_y': the column is missing" in done.stdout + done.stderr
    assert "Traceback" not in done.stdout + done.stderr


def _errors(data: Path, arm: str, samples: int) -> tuple[dict[str, float], int, int]:
    """Tip errors on what was held back, mm, and how much of it the arm's intervals hold; samples of both fits."""
    settings = composed_identify(f"arm={arm}", f"data={data}", f"fit.samples={samples}", "fit.rounds=2")
    series, parts = composition.recorded(settings)
    used = thinned(parts.training, samples)
    assert not set(used.tolist()) & set(parts.validation.tolist())
    drive = series.drive(settings.fit.history, settings.fit.slide_travel)
    task = Task(series, drive, used, settings.fit, lambda line: None)
    tendon_arm, blocks = TendonArm(settings.arm), composition.parameters(settings)
    model = identified(task, tendon_arm, blocks)
    predictions = compare(series, parts, used) | {"arm": model.prediction}
    held = parts.validation
    found = {name: error(series.positions[held, -1], p[held, -1]) for name, p in predictions.items()}
    within = half_widths(tendon_arm, blocks, drive.rows(held), model.fit)
    found["covered"] = float(coverage(model.prediction[held], within, series.positions[held])[-1])
    return found, len(used), len(parts.training)


def test_real_nine_tendon_arm_is_three_times_better_than_linear_regression(shared_data: Path) -> None:
    found, _, _ = _errors(shared_data / "ftdcr_v6" / "train.csv", "ftdcr_v6", samples=270)
    assert found["linear"] >= 3.0 * found["arm"]
    assert found["mean"] > found["linear"]
    assert 0.9 <= found["covered"] <= 0.99


def test_real_trunk_beats_linear_regression_with_a_tenth_of_its_samples(shared_data: Path) -> None:
    found, used, trained = _errors(shared_data / "trunk", "trunk", samples=200)
    assert used < trained / 10
    assert found["arm"] < found["linear"]
    assert found["arm"] < found["linear_few"]
    assert 0.9 <= found["covered"] <= 0.99


def test_a_fit_that_must_not_be_used_says_so(tmp_path: Path) -> None:
    """A recording whose motors do not drive what was filmed, and in which a body is lost most of the time."""
    path = write_recording(tmp_path, count=60)
    lines = [line.split(",") for line in path.read_text().splitlines()]
    inputs = [line[2:8] for line in lines[1:]]
    for k, line in enumerate(lines[1:]):
        line[2:8] = inputs[(17 * k + 5) % len(inputs)]
        if k % 3:
            line[-3:] = ["", "", ""]
    path.write_text("\n".join(",".join(line) for line in lines) + "\n")
    short = ("fit.steps=2", "fit.rounds=1", "fit.samples=12", "online.samples=5", "figures=false", "split.folds=2")
    done = _identify(tmp_path, "arm=small.yaml", f"data={path}", *READ, *FIT, *short, "hydra.run.dir=out")
    assert done.returncode == 0, done.stdout + done.stderr
    out = tmp_path / "out"
    metrics, table = json.loads((out / "metrics.json").read_text()), (out / "table.txt").read_text()
    assert metrics["fit_usable"] == 0.0 and not json.loads((out / "parameters.json").read_text())["usable"]
    assert metrics["frames_without_a_body_percent"] == pytest.approx(100 * 40 / 60)
    assert table.startswith("Do not use this fit: ") and "67 % of the frames lack a body" in table
    assert "Do not use this arm: " in (out / "arm.yaml").read_text() and "Do not use this fit" in done.stdout


@pytest.mark.parametrize(
    ("tip", "nominal", "mean", "reasons"),
    [
        (1.0, 2.0, 3.0, []),
        (2.5, 2.0, 3.0, ["the arm as built"]),
        (4.0, math.nan, 3.0, ["the mean position"]),
        (math.nan, 2.0, 3.0, ["the arm as built", "the mean position"]),
    ],
)
def test_why_a_fit_is_of_no_use(tip: float, nominal: float, mean: float, reasons: list[str]) -> None:
    errors = {"arm_identified": tip, "arm_nominal": nominal, "mean": mean}
    told = why_not({f"{k}_tip_rmse_mm": v for k, v in errors.items()} | {"frames_without_a_body_percent": 0.0})
    assert len(told) == len(reasons) and all(what in why for why, what in zip(told, reasons, strict=True))
