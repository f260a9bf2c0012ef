"""The limits of a run: nothing that was run is better than them, and they are what they say."""

from __future__ import annotations

import pytest
import torch

from apcc_torch.composition.build import Builder
from apcc_torch.experiments.dynamic import simulate, thinned
from apcc_torch.paper.best_lengths import PRICES, Limits, length_grid, limits, splits
from apcc_torch.simulation.metrics import backbone_error
from composed import composed


@pytest.fixture(scope="module")
def found() -> tuple[Limits, float, float]:
    config = composed(
        "experiment=dynamic_single", "experiment.duration=1.5", "progress=false", "controller.adaptive=false"
    )
    log, arms = simulate(config, False, "")
    at = log.time.shape[0] - 1
    pi = log.pi_hat[at]
    own = backbone_error(arms.true, log.q_true[at], arms.true_lengths, arms.model, log.q_bar[at], pi, 60)
    return limits(config, log, arms), float(own.max()), float(log.linear_error[at].max())


def test_nothing_is_below_the_limit(found: tuple[Limits, float, float]) -> None:
    limit, shape, linear = found
    assert 0.0 < float(limit.shape[-1].max()) < 0.5 * shape
    assert 0.0 < float(limit.linear[-1].max()) < linear
    assert bool((limit.front[:, 0] >= limit.shape - 1e-12).all())
    assert bool((limit.front[:, 1] >= limit.psi - 1e-12).all())


def test_the_front_trades_shape_for_elongation(found: tuple[Limits, float, float]) -> None:
    limit = found[0]
    pairs = limit.trade_off()
    assert len(pairs) == len(PRICES)
    shapes, psis = zip(*pairs, strict=True)
    assert list(shapes) == sorted(shapes) and list(psis) == sorted(psis, reverse=True)


def test_rows_and_names(found: tuple[Limits, float, float]) -> None:
    limit = found[0]
    assert limit.rows([0]).metrics() == limit.metrics()
    third = 1e3 * limit.linear[..., 2].mean(-1)
    assert limit.metrics()["sensor_3_error_linear_mean_mm"] == pytest.approx(float((limit.share * third).sum()))


def test_an_instant_stands_for_the_time_around_it() -> None:
    # A curve that is straight in time has the mean of its middle, wherever the instants are.
    config = composed(
        "experiment=dynamic_single", "experiment.duration=0.5", "progress=false", "controller.adaptive=false"
    )
    log, arms = simulate(config, False, "")
    limit = limits(config, log, arms)
    assert float(limit.share.sum()) == pytest.approx(1.0)
    instants = thinned(log, len(limit.share)).time
    assert len(instants) == len(limit.share)
    assert limit.mean(instants.unsqueeze(-1)) == pytest.approx(0.25, abs=0.01)


def test_the_grid_goes_around_the_nominal_lengths_and_holds_them() -> None:
    build = Builder(composed("experiment=dynamic_run_2"))
    grid, nominal = length_grid(build), build.rest_lengths()
    for share in (0.75, 1.25):
        assert bool((grid - share * nominal).abs().amax(-1).min() < 1e-12)
    torch.testing.assert_close(grid[0], nominal)
    assert len(grid.unique(dim=0)) > 150


def test_splits_keep_the_sum_and_are_those_that_the_sensors_tell() -> None:
    nominal, abscissae = torch.tensor([0.2, 0.3], dtype=torch.float64), torch.tensor([0.25, 0.5], dtype=torch.float64)
    # 0.4 of 0.2 m ends at 0.08 m, 1.2 of it at 0.24, 1.5 at 0.3: a sensor in the first section or the next is in each.
    found = splits(nominal, abscissae)
    torch.testing.assert_close(found[0], nominal)
    torch.testing.assert_close(found.sum(-1), torch.full((6,), 0.5, dtype=torch.float64))
    assert sorted(found[:, 0].tolist()) == pytest.approx([0.08, 0.12, 0.16, 0.2, 0.24, 0.3])
    assert splits(nominal, abscissae[:1]).tolist() == [nominal.tolist()], "one sensor tells nothing of two sections"
    short = splits(nominal, torch.tensor([0.05, 0.1], dtype=torch.float64))
    assert short[:, 0].tolist() == pytest.approx([0.2, 0.08]), "a longer first section would hold both"
    assert splits(nominal[:1], abscissae).tolist() == [[0.2]]
