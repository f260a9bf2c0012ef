"""The sign of what comparison C says that the shipped law wins, on two held-out runs, short."""

from __future__ import annotations

import pytest
from hydra import compose, initialize_config_dir

from apcc_torch.benchmark import compose_grids
from apcc_torch.composition.benchmark import BenchmarkSettings
from apcc_torch.composition.schema import typed
from apcc_torch.conf_path import conf_path
from apcc_torch.experiments.dynamic import metrics, simulate

SHORT = [
    "~grid.comparisons.A", "~grid.comparisons.B", "~grid.comparisons.C.runs.run_1", "~grid.comparisons.C.runs.robot_2",
    "grid.setpoints=4", "grid.payloads=[0.5]", "grid.duration=2.5", "progress=false",
    'experiments.common=["compile=off","controller.rate=25","plant.substeps=4","plant.settle=1.0","experiment.subset=held_out"]',
]  # fmt: skip


@pytest.fixture(scope="module")
def reached() -> dict[str, dict[str, float]]:
    """Row -> metrics, of run II's second and fourth set-point with the largest payload."""
    with initialize_config_dir(conf_path(), version_base="1.3"):
        rows = compose_grids(typed(compose("benchmark", SHORT), BenchmarkSettings))["C"]["run_2"]
    return {name: metrics(simulate(rows[name].config)) for name in ("standard", "adaptive")}


@pytest.mark.parametrize("metric", ["shape_error_mean_mm", "shape_error_end_mm", "psi_mean_cm"])
def test_the_shipped_law_beats_fixed_nominal_lengths(reached: dict[str, dict[str, float]], metric: str) -> None:
    assert reached["standard"]["rows"] == reached["adaptive"]["rows"] == 2.0
    assert reached["adaptive"]["diverged_rows"] == 0.0
    assert reached["adaptive"][metric] < reached["standard"][metric]
