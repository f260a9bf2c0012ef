"""The limits of a run: nothing that was run is better than them, and they are what they say."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch

from apcc_torch.composition.build import Builder
from apcc_torch.experiments.dynamic import simulate, thinned
from apcc_torch.paper.best_lengths import PRICES, Limits, length_grid, limits
from apcc_torch.simulation.metrics import backbone_error
from apcc_torch.spread import spread
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


def test_the_grid_spans_the_bounds_and_more_and_holds_the_nominal_lengths() -> None:
    config = composed("experiment=dynamic_run_2")
    grid = length_grid(config, Builder(config))
    nominal = config.arm.rest_lengths()
    lower, upper = (spread("bounds", b, 3) * nominal for b in (config.bounds.lower, config.bounds.upper) if b)
    for corner in (lower, upper):
        assert bool((grid - corner).abs().amax(-1).min() < 1e-12)
    assert bool((grid.amin(0) <= lower).all()) and bool((grid.amax(0) >= upper).all())
    torch.testing.assert_close(grid[0], nominal)
    free = replace(config, bounds=replace(config.bounds, lower=None, upper=None))
    corner = 1.25 * grid[0]
    assert bool((length_grid(free, Builder(free)) - corner).abs().amax(-1).min() < 1e-12)
