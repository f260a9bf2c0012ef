"""A run in numbers that take no more memory the longer it is."""

from __future__ import annotations

import tracemalloc

import numpy as np
import pytest

from apcc_torch.hardware.stage_times import EXACT, StageTimes
from apcc_torch.hardware.summary import EVENTS, LAST, Summary
from fake_runs import fake_run


@pytest.mark.parametrize("count", [1, 100, EXACT, 3 * EXACT])
def test_percentiles_are_those_of_all_times(count: int) -> None:
    values = np.random.default_rng(count).lognormal(-7.0, 0.5, count)
    times = StageTimes()
    for value in values:
        times.add(float(value))
    for share in (50, 99, 99.9):
        exact = float(np.percentile(values, share))
        assert times.percentile(share) == pytest.approx(exact, rel=0.0 if count <= EXACT else 0.02)
    assert times.count == count and times.largest == values.max()


def test_times_that_are_none_and_times_that_never_end() -> None:
    times = StageTimes()
    for k in range(2 * EXACT):
        times.add(0.0 if k % 2 else 1e6)
    assert times.percentile(25) < 1e-6 and times.percentile(99) > 500.0 and np.isnan(StageTimes().percentile(50))


def test_the_memory_does_not_grow_with_the_run() -> None:
    run = fake_run()
    (tick,) = [tick for tick in run.witness.ticks if tick.decision is not None][:1]
    assert tick.decision is not None
    summary, failed = Summary(), run.witness.events[0]
    object.__setattr__(failed, "kind", "exchange_failed")

    def go_on(turns: int) -> None:
        for _ in range(turns):
            object.__setattr__(tick.decision, "time", tick.decision.time + 0.01)  # type: ignore[union-attr]
            summary.on_tick(tick)
            summary.on_event(failed)

    go_on(EVENTS + 100)
    tracemalloc.start()
    try:
        go_on(100)
        before = tracemalloc.get_traced_memory()[0]
        go_on(5000)
        assert tracemalloc.get_traced_memory()[0] - before < 50_000
    finally:
        tracemalloc.stop()
    assert len(summary.last_errors) == pytest.approx(LAST / 0.01, abs=2) and summary.steps == EVENTS + 5200
    assert len(summary.events) == EVENTS
