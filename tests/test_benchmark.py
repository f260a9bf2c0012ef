"""python -m apcc_torch.benchmark as a user runs it."""

from __future__ import annotations

import json
import sys
from contextlib import suppress
from pathlib import Path

import numpy as np
import pytest
from omegaconf import OmegaConf

from apcc_torch.benchmark import main
from apcc_torch.paper.figures import NUMBERED
from commands import environment
from started import ran

RUN_2 = (
    "~grid.comparisons.B", "~grid.comparisons.C",
    "~grid.comparisons.A.runs.run_1", "~grid.comparisons.A.runs.robot_2",
)  # fmt: skip
"""Nothing but run II."""


@pytest.fixture(scope="module")
def finished(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, str]:
    """The folder of a very short benchmark of run II alone, and what the program printed."""
    folder = tmp_path_factory.mktemp("benchmark")
    quick = '["controller.rate=20","plant.settle=0.1","plant.substeps=2"]'
    words = [
        "grid=small", "grid.duration=0.2", "hydra.run.dir=out", *RUN_2,
        f"experiments.common={quick}", 'experiments.adaptive=["adaptation=normalised"]',
    ]  # fmt: skip
    done = ran("apcc_torch.benchmark", words, folder, environment())
    assert done.returncode == 0, done.stderr
    return folder / "out", done.stdout


def test_folder_is_whole(finished: tuple[Path, str]) -> None:
    folder, printed = finished
    metrics = json.loads((folder / "metrics.json").read_text())
    table = json.loads((folder / "table.json").read_text())
    assert metrics["run_2_adaptive_rows"] == 4 and metrics["run_2_held_out_standard_rows"] == 2
    assert metrics["wall_s"] > metrics["run_2_standard_wall_s"] > 0
    assert set(table["A"]) == {f"run_2{part}" for part in ("", "_held_out", "_single")}
    assert {"torch", "seeds"} <= set(json.loads((folder / "versions.json").read_text()))
    assert (folder / "table.txt").read_text() in printed
    assert (folder / "benchmark.log").stat().st_size > 0


def test_figures_carry_the_papers_numbers(finished: tuple[Path, str]) -> None:
    names = {path.name for path in (finished[0] / "figures").iterdir()}
    drawn = {f"figure_{number}.png" for number, (run, _, _) in NUMBERED.items() if run.startswith("run_2")}
    drawn |= {"trade_off.png"}
    films = {Path(name).stem for name in names - drawn}
    assert drawn <= names
    assert films == {"single_run_standard", "single_run_adaptive"}


def test_config_holds_every_runs_settings(finished: tuple[Path, str]) -> None:
    config = OmegaConf.load(finished[0] / "config.yaml")
    runs = config.runs.A
    assert config.benchmark.grid.name == "small"
    assert runs.run_2.standard.adaptation.kind.endswith("ShapeLaw")
    assert runs.run_2.adaptive.adaptation.kind.endswith("NormalisedLaw")
    assert runs.run_2.standard.controller.rate == 20.0
    assert runs.run_2.standard.experiment.payloads == [0.0, 0.5]


def test_logs_are_kept(finished: tuple[Path, str]) -> None:
    with np.load(finished[0] / "data" / "A_run_2_adaptive.npz") as log:
        assert log["q_true"].shape == (5, 4, 18)
        assert log["time"][-1] == pytest.approx(0.2)


def test_help_teaches(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    monkeypatch.setattr(sys, "argv", ["apcc-benchmark", "--help"])
    with suppress(SystemExit):
        main()
    printed = capsys.readouterr().out
    assert "table.json" in printed and "    paper  " in printed and "    small  " in printed
    assert "experiments.common=[]" in printed and "[ours] how many of each experiment's set-points" in printed
    assert "hardware" not in printed and "guards" not in printed, "what it does not read"


@pytest.mark.parametrize(
    ("argument", "sentence"),
    [
        ("grid.setpoints=11", "grid.setpoints must be between 1 and 10, got 11"),
        ('experiments.common=["controller.gama=1"]', "controller.gama is no setting"),
        ('experiments.adaptive=["adaptation=none","adaptation.rate=1"]', "adaptation.rate is read by nothing"),
        ("grid.comparisons.A.runs.run_1.standard=dynamic_run_7", "dynamic_run_7"),
    ],
)
def test_wrong_settings_end_in_one_sentence(
    argument: str, sentence: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    refused([argument], tmp_path, monkeypatch, caplog, sentence)


def test_runs_of_other_set_points_are_not_compared(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    pair = "grid.comparisons.A.runs.run_2={standard: dynamic_run_2, adaptive: robot_2}"
    refused([pair, *RUN_2], tmp_path, monkeypatch, caplog, "same experiment.setpoints")


UNREAD = [
    (
        'experiments.common=["plant.refine=2","experiment.omega=2"]',
        "experiment.omega is read by nothing: experiment.setpoints",
    ),
    (
        'experiments.standard=["adaptation=normalised"]',
        "adaptation is read by nothing: controller.adaptive is false",
    ),
    ('experiments.common=["jobs=3"]', "jobs is read by nothing: the benchmark runs its grids itself"),
]
SET_BY_THE_COMPARISON = [
    (
        'experiments.common=["controller.adaptive=true"]',
        "experiments.common must not set controller.adaptive, the comparison itself does: its rows are",
    ),
    (
        'experiments.adaptive=["++controller={K:2.0,adaptive:false}"]',
        "experiments.adaptive must not set controller.ad",
    ),
    (
        'experiments.common=["experiment.payloads=[0.1]"]',
        "must not set experiment.payloads, grid.payloads does: change that, or make it null",
    ),
    ('experiments.standard=["experiment.duration=3"]', "must not set experiment.duration, grid.duration does"),
]


@pytest.mark.parametrize(("argument", "sentence"), [*UNREAD, *SET_BY_THE_COMPARISON])
def test_what_no_run_reads_or_the_comparison_sets_is_refused(
    argument: str, sentence: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    refused(["grid=small", *RUN_2, argument], tmp_path, monkeypatch, caplog, sentence)


@pytest.mark.parametrize(
    ("argument", "sentence"),
    [
        ('experiments.common=["adaptation=normalised"]', "set adaptation, the row itself does with adaptation="),
        ('experiments.common=["controller.adaptive=false"]', "the row itself does with controller.adaptive=false"),
        ('experiments.common=["adaptation.gamma=3"]', "adaptation.gamma is no setting; "),
    ],
)
def test_rows_that_differ_in_their_law_keep_it(
    argument: str, sentence: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    refused(
        ["grid=small", "~grid.comparisons.A", "~grid.comparisons.B", argument], tmp_path, monkeypatch, caplog, sentence
    )


def refused(
    words: list[str],
    folder: Path,
    monkeypatch: pytest.MonkeyPatch,
    caplog: pytest.LogCaptureFixture,
    sentence: str,
) -> None:
    quiet = ("hydra/job_logging=none", "hydra/hydra_logging=none")  # the process's logging stays as it is
    monkeypatch.setattr(sys, "argv", ["apcc-benchmark", *words, f"hydra.run.dir={folder}", *quiet])
    with pytest.raises(SystemExit) as stopped:
        main()
    assert stopped.value.code == 2
    assert sentence in caplog.text and "Traceback" not in caplog.text
