"""One run of a configuration: its objective, and bad runs that end early."""

from __future__ import annotations

import json
import math
from pathlib import Path
from types import SimpleNamespace

import pytest

from apcc_torch.composition.run_settings import SimulateSettings
from apcc_torch.errors import ApccError, ConfigError
from apcc_torch.experiments.kinds import KINDS
from apcc_torch.experiments.run import objective_in, objective_value, run, settings_of
from composed import changed, raw


def fake(config: SimulateSettings, folder: Path) -> dict[str, float]:
    """An experiment whose error grows with its gain and its length, and whose rows diverge at a gain of 9."""
    metrics = {
        "error_mm": float(config.controller.K) * config.experiment.duration,
        "rows": 4.0,
        "diverged_rows": 3.0 if config.controller.K == 9 else 0.0,
    }
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "metrics.json").write_text(json.dumps(metrics))
    (folder / "figures.txt").write_text(str(config.figures))
    return metrics


@pytest.fixture(autouse=True)
def _fake_experiment(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(KINDS, "kinematic", SimpleNamespace(run=fake))


def settings(*overrides: str) -> SimulateSettings:
    return changed("kinematic", "experiment.duration=10", "objective=error_mm", "prune.after=2", *overrides)


def test_a_good_run_is_run_whole_and_its_try_leaves_nothing(tmp_path: Path) -> None:
    metrics = run(settings("prune.above=3", "controller.K=1.5"), tmp_path)
    assert metrics["error_mm"] == 15.0
    assert {path.name for path in tmp_path.iterdir()} == {"metrics.json", "figures.txt"}
    assert (tmp_path / "figures.txt").read_text() == "True"
    assert objective_in(tmp_path, "error_mm") == 15.0 and objective_in(tmp_path, None) is None


@pytest.mark.parametrize(
    ("gain", "above", "why"),
    [("1.5", "2.9", "error_mm is 3 after 2.0 s, above 2.9"), ("9", "null", "3 of 4 rows diverged within 2.0 s")],
)
def test_a_bad_run_ends_after_its_try(tmp_path: Path, gain: str, above: str, why: str) -> None:
    run(settings(f"prune.above={above}", f"controller.K={gain}"), tmp_path)
    # It must not look like a whole run.
    assert {path.name for path in tmp_path.iterdir()} == {"pruned.json", "versions.json"}
    record = json.loads((tmp_path / "pruned.json").read_text())
    assert record["why"] == why and record["metrics"]["rows"] == 4.0 and record["after"] == 2.0
    assert objective_in(tmp_path, "error_mm") == math.inf


def test_without_a_bound_only_divergence_ends_a_run_early(tmp_path: Path) -> None:
    assert run(settings("controller.K=1000", "objective=null"), tmp_path)["error_mm"] == 10000.0


@pytest.mark.parametrize("after", ["0", "-1", "10", "11"])
def test_a_try_is_shorter_than_the_run(tmp_path: Path, after: str) -> None:
    with pytest.raises(ApccError, match=r"prune\.after"):
        run(settings(f"prune.after={after}"), tmp_path)


def test_a_bound_needs_an_objective(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"prune\.above"):
        run(settings("prune.above=3", "objective=null"), tmp_path)


@pytest.mark.parametrize(
    ("metrics", "value"),
    [
        ({"a": 2.0}, 2.0),
        ({"a": 2.0, "diverged_rows": 0.0}, 2.0),
        ({"a": 2.0, "diverged_rows": 1.0}, math.inf),
        ({"a": math.nan}, math.inf),
        ({"a": -math.inf}, math.inf),
    ],
)
def test_the_objective_is_infinite_where_the_run_went_wrong(metrics: dict[str, float], value: float) -> None:
    assert objective_value(metrics, "a") == value


def test_an_unknown_objective_is_refused_with_what_there_is() -> None:
    with pytest.raises(ConfigError, match="objective must be one of a, b, got 'c'"):
        objective_value({"a": 1.0, "b": 2.0}, "c")


def test_settings_are_left_resolved(tmp_path: Path) -> None:
    config = settings_of(raw("experiment=kinematic", "seed=${threads}"), tmp_path)
    assert config.seed == config.threads == 1
    assert "seed: 1\n" in (tmp_path / "config.yaml").read_text()
