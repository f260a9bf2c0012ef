"""A run's numbers are on the disk before anything is drawn, and stay there if nothing can be."""

from __future__ import annotations

from pathlib import Path
from types import ModuleType
from typing import Any

import pytest

from apcc_torch.experiments import dynamic, kinematic
from composed import changed

QUICK = ("progress=false", "controller.rate=50", "experiment.duration=0.1", "plant.settle=0.1")


@pytest.mark.parametrize(("kind", "experiment"), [(kinematic, "kinematic"), (dynamic, "dynamic_single")])
def test_the_numbers_come_first(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, kind: ModuleType, experiment: str
) -> None:
    there: list[set[str]] = []

    def draw(outcome: Any, folder: Path, *names: str) -> None:
        there.append({path.name for path in folder.parent.iterdir()})

    monkeypatch.setattr(kind, "draw", draw)
    kind.run(changed(experiment, *QUICK), tmp_path)
    assert there == [{"trajectory.npz", "versions.json", "metrics.json"}]


def test_a_run_whose_figures_cannot_be_written_is_complete(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    (tmp_path / "figures").write_text("in the way")
    metrics = kinematic.run(changed("kinematic", *QUICK), tmp_path)
    assert metrics["wall_s"] > 0 and (tmp_path / "metrics.json").is_file()
    told = [record.getMessage().split(":")[0] for record in caplog.records if record.name.startswith("apcc_torch")]
    assert told == [f"figure_{k}.png is not drawn" for k in (7, 8, 9)]
