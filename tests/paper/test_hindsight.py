"""The search for constants in hindsight: it finds what is known to be best, and what it finds is what it says."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from torch import Tensor

from apcc_torch.composition.run_settings import SimulateSettings
from apcc_torch.errors import ConfigError
from apcc_torch.experiments.dynamic import simulate
from apcc_torch.paper.hindsight import Found, best_gamma, best_lengths, best_of, score, scores, training, with_found
from composed import composed

QUICK = (
    "experiment.duration=0.4", "controller.rate=20", "plant.settle=0.1", "plant.substeps=2", "progress=false",
    "experiment.setpoints=[[0.15,0.1,-0.52]]", "feedback.angular_weight=0.03",
)  # fmt: skip


@pytest.fixture(scope="module")
def single() -> SimulateSettings:
    return composed("experiment=dynamic_single", *QUICK)


@pytest.mark.parametrize("seed", range(4))
def test_a_valley_is_found_and_what_cannot_be_run_is_not(seed: int) -> None:
    best = torch.tensor([0.2, 0.55, 0.7]).double()

    def valley(points: Tensor) -> Tensor:
        d = points - best
        value = 100.0 * (d[:, 0] + d[:, 1]).square() + d[:, 0].square() + 30.0 * d[:, 2].square()
        return torch.where(points[:, 0] > 0.6, torch.nan, value)

    point, least = best_of(valley, 3, torch.full((1, 3), 0.5).double(), 8, 40, seed)
    assert 0.0 <= least < 2e-3 and least == pytest.approx(float(valley(point.unsqueeze(0))[0]))
    assert float(point[2]) == pytest.approx(0.7, abs=0.02) and float(point[0]) == pytest.approx(0.2, abs=0.1)


def test_tuning_looks_at_the_training_setpoints_alone(single: SimulateSettings) -> None:
    whole = composed("experiment=dynamic_run_2")
    assert training(whole).experiment.subset == "training" and whole.experiment.subset == "all"
    assert training(single) == single, "the only set-point there is"


def constant(config: SimulateSettings, *share: float) -> SimulateSettings:
    return with_found(config, Found("experiment.first_estimate", share, 0.0, 0))


def test_candidates_side_by_side_have_the_scores_that_each_has_alone(single: SimulateSettings) -> None:
    some = [constant(single, 1.0, 1.0, 1.0), constant(single, 0.9, 0.6, 1.5), constant(single, 1.2, 0.8, 1.1)]
    together = scores(some)
    assert float(together.std()) > 0.1, "they are told apart"
    for config, beside in zip(some, together.tolist(), strict=True):
        assert config.controller.adaptive is False
        assert score(simulate(config)) == pytest.approx(beside, rel=1e-9)


def test_the_best_lengths_are_within_bounds_and_no_worse_than_the_nominal_ones(single: SimulateSettings) -> None:
    found = best_lengths(single, rounds=2, candidates=8)
    assert found.tried == 16 and found.score <= float(scores([constant(single, 1.0, 1.0, 1.0)])[0]) * (1 + 1e-9)
    assert score(simulate(with_found(single, found))) == pytest.approx(found.score, rel=1e-9)
    narrow = best_lengths(single.changed(bounds=single.bounds.changed(lower=0.9, upper=1.1)), rounds=1, candidates=4)
    for each, lower, upper in ((found, 0.2, 2.0), (narrow, 0.9, 1.1)):
        assert all(lower - 1e-9 <= value <= upper + 1e-9 for value in each.value)


def test_a_gamma_is_found_where_the_law_has_one(single: SimulateSettings) -> None:
    with pytest.raises(ConfigError, match="a law with a gamma"):
        best_gamma(single)
    law = composed("experiment=dynamic_single", "adaptation=estimator_aware", *QUICK)
    found = best_gamma(law, rounds=1, candidates=4)
    assert found.name == "adaptation.gamma" and 1e-3 <= found.value[0] <= 1e3 * (1 + 1e-9)
    tuned = with_found(law, found)
    assert score(simulate(replace(tuned, progress=False))) == pytest.approx(found.score, rel=1e-9)
