"""A search over gains with Optuna: it lowers the named metric, and bad trials end early and end nothing."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
import yaml

from commands import ONE_BY_ONE, simulate
from composed import raw

pytest.importorskip("hydra_plugins.hydra_optuna_sweeper")

SEARCH = (
    ONE_BY_ONE,
    "experiment=dynamic_run_2",
    "sweep=optuna_gains",
    "experiment.duration=0.3",
    "experiment.payloads=[0.0]",
    "experiment.setpoints=[[0.325,0.15,-0.275],[0.215,0.03,-0.515]]",
    "plant.settle=0.2",
    "controller.rate=50",
    "hydra.sweeper.n_trials=4",
    "hydra.sweeper.sampler.n_startup_trials=2",
    "prune.after=0.1",
    "hydra.sweep.dir=search",
)


def values(search: Path) -> dict[str, float]:
    """Each finished trial's objective; a pruned one has none."""
    return {
        path.parent.name: json.loads(path.read_text())["shape_error_mean_mm"] for path in search.glob("*/metrics.json")
    }


def test_a_search_finds_the_best_of_its_trials_and_goes_through_them_again_when_resumed(tmp_path: Path) -> None:
    search = tmp_path / "search"
    done = simulate(tmp_path, *SEARCH)
    assert done.returncode == 0, done.stdout + done.stderr
    found = values(search)
    assert len(found) == 4 and len(set(found.values())) == 4
    results = yaml.safe_load((search / "optimization_results.yaml").read_text())
    assert results["best_value"] == min(found.values())
    assert set(results["best_params"]) == {"controller.null_gain", "controller.K"}
    best = min(found, key=lambda name: found[name])
    assert f"best shape_error_mean_mm: {found[best]:.6g}, in {best}," in done.stdout
    # Tuning looks at the training set-points only.
    assert all(json.loads((search / name / "metrics.json").read_text())["rows"] == 1 for name in found)

    dates = {path: path.stat().st_mtime_ns for path in search.glob("*/metrics.json")}
    (search / "2").rename(tmp_path / "taken away")
    again = simulate(tmp_path, *SEARCH, "resume=true")
    assert again.returncode == 0, again.stdout + again.stderr
    assert values(search) == found, "the same trials, and the same results of the one that was run again"
    kept = {path for path, date in dates.items() if path.is_file() and path.stat().st_mtime_ns == date}
    assert {path.parent.name for path in kept} == {"0", "1", "3"}


def test_bad_trials_end_early_and_end_nothing(tmp_path: Path) -> None:
    search = tmp_path / "search"
    # A bound that no arm can meet.
    done = simulate(tmp_path, *SEARCH, "prune.above=0.0", "hydra.sweeper.n_trials=2")
    pruned = [json.loads(path.read_text()) for path in search.glob("*/pruned.json")]
    assert len(pruned) == 2 and not values(search)
    assert all("shape_error_mean_mm is" in record["why"] and record["after"] == 0.1 for record in pruned)
    assert done.returncode == 0, "a pruned trial is no failure"
    assert done.stdout.count("pruned: ") == 2 and "best" not in done.stdout


def test_a_trial_that_fails_is_named_and_the_search_goes_on(tmp_path: Path) -> None:
    # What no settings say: a device that is not there.
    done = simulate(tmp_path, *SEARCH, "device=cpu,cuda:63")
    failed = {path.parent.name: json.loads(path.read_text())["why"] for path in tmp_path.glob("search/*/failure.json")}
    assert failed and all("cuda" in why for why in failed.values())
    assert len(values(tmp_path / "search")) == 4 - len(failed) >= 1
    assert done.returncode == 1 and all(f"failed: {name}" in done.stdout for name in failed)
    assert (tmp_path / "search" / "optimization_results.yaml").is_file()


def test_the_search_is_over_the_training_set_points() -> None:
    config = raw("experiment=dynamic_run_2", "sweep=optuna_gains")
    assert config.experiment.subset == "training" and config.objective == "shape_error_mean_mm"
