"""What one controller did over a grid of runs, and what of it belongs to the held-out set-points or the single run."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from typing import NamedTuple

from apcc_torch.composition.run_settings import SimulateSettings
from apcc_torch.experiments.dynamic import Arms, curves, simulate, thinned
from apcc_torch.experiments.dynamic_metrics import dynamic_metrics, effort_metrics
from apcc_torch.experiments.folder import warn
from apcc_torch.model.arm import Lengths
from apcc_torch.paper.best_lengths import Limits, limits
from apcc_torch.paper.hindsight import Found, best_gamma, best_lengths, with_found
from apcc_torch.report.dynamic import RunCurves
from apcc_torch.simulation.divergence import sentence
from apcc_torch.simulation.dynamic import DynamicLog

HELD_OUT, SINGLE = "_held_out", "_single"
SEARCHES: Mapping[str, Callable[[SimulateSettings], Found]] = {"lengths": best_lengths, "gamma": best_gamma}
"""What a row may ask for -> what finds it."""


class Row(NamedTuple):
    """The settings of one row of a comparison, and what is searched for it: "lengths", "gamma" or nothing."""

    config: SimulateSettings
    searched: str | None = None


class Outcome(NamedTuple):
    """One controller over R rows, thinned in time; with the limits of its motion and what was searched for it."""

    log: DynamicLog
    arms: Arms
    curves: RunCurves
    metrics: Mapping[str, float]
    limits: Limits | None
    found: Found | None = None

    def rows(self, index: Sequence[int]) -> Outcome:
        """Some rows alone, with their own metrics."""
        at = list(index)
        timed = self.log._asdict()
        time, diverged_at = timed.pop("time"), timed.pop("diverged_at")[at]
        log = DynamicLog(time=time, diverged_at=diverged_at, **{name: field[:, at] for name, field in timed.items()})
        c = RunCurves(self.curves.time, *(field[:, at] for field in self.curves[1:]))
        limits = None if self.limits is None else self.limits.rows(at)
        return Outcome(log, self.arms, c, grid_metrics(log, c), limits, self.found)


Outcomes = Mapping[str, Mapping[str, Outcome]]
"""Run -> row ("standard", "adaptive", or a law's) -> outcome."""


def grid_metrics(log: DynamicLog, c: RunCurves) -> dict[str, float]:
    """The metrics of a dynamic run, and the edges of the figures' shaded bands averaged over time."""
    edges = {
        "shape_error_lower_edge_mm": 1e3 * c.shape_error.amin(1).mean(),
        "shape_error_upper_edge_mm": 1e3 * c.shape_error.amax(1).mean(),
        "psi_lower_edge_cm": 1e2 * c.psi.amin(1).mean(),
        "psi_upper_edge_cm": 1e2 * c.psi.amax(1).mean(),
    }
    return dynamic_metrics(c) | effort_metrics(log) | {name: float(value) for name, value in edges.items()}


def outcome(row: Row, limited: bool, label: str) -> Outcome:
    """Searches what the row asks for, and runs it over its experiment's whole grid.

    Args:
        row: Settings.
        limited: Whether the limits of its motion are wanted.
        label: Of the progress bar.

    Raises:
        ConfigError, ValueRangeError: A setting has no meaning.
    """
    started = time.perf_counter()
    found = None if row.searched is None else SEARCHES[row.searched](row.config)
    config = row.config if found is None else with_found(row.config, found)
    log, arms = simulate(config, label=label)
    thin = thinned(log)
    c = curves(thin, arms)
    metrics = grid_metrics(thin, c)
    warn(sentence(c.time, c.diverged), label)
    best = limits(config, thin, arms) if limited else None
    return Outcome(thin, arms, c, metrics | {"wall_s": time.perf_counter() - started}, best, found)


def held_out_rows(setpoints: int, payloads: int) -> list[int]:
    """Rows of the set-points with odd index; payloads are fastest."""
    return [s * payloads + p for s in range(1, setpoints, 2) for p in range(payloads)]


def single_row(payloads: Lengths) -> int:
    """Row of the first set-point, the one the paper names, with the largest payload."""
    return max(range(len(payloads)), key=lambda p: float(payloads[p]))


def parts(run: str, both: Mapping[str, Outcome], config: SimulateSettings) -> dict[str, dict[str, Outcome]]:
    """A run's held-out twin and its single run, without running anything again.

    Args:
        run: Name of the run.
        both: Controller -> outcome of the whole grid.
        config: Settings of the run.
    """
    e = config.experiment
    held_out = held_out_rows(len(e.setpoints or ()), len(e.payloads))
    best = {run + SINGLE: {name: o.rows([single_row(e.payloads)]) for name, o in both.items()}}
    if held_out:
        best[run + HELD_OUT] = {name: o.rows(held_out) for name, o in both.items()}
    return best
