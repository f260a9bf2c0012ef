"""Section V-B and Appendix A whole: every run with both controllers, one table beside the paper's, and its figures."""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Iterator, Mapping
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import torch

from apcc_torch import processes
from apcc_torch.composition.benchmark import BenchmarkSettings, GridSettings
from apcc_torch.composition.run_settings import SimulateSettings
from apcc_torch.errors import ConfigError
from apcc_torch.experiments.folder import progress_bar, versions
from apcc_torch.files import write_arrays, write_atomically, write_json
from apcc_torch.paper.comparison_table import flat_metrics, table, text
from apcc_torch.paper.figures import save_paper_figures
from apcc_torch.paper.outcomes import Outcome, Outcomes, outcome, parts

CONTROLLERS = ("standard", "adaptive")


class Pair(NamedTuple):
    """The settings of one run, a controller each."""

    standard: SimulateSettings
    adaptive: SimulateSettings


Pairs = Mapping[str, Mapping[str, Pair]]
"""Comparison -> run -> settings."""


def on_grid(config: SimulateSettings, grid: GridSettings, adaptive: bool) -> SimulateSettings:
    """An experiment's settings cut to the benchmark's grid, for one controller.

    Args:
        config: The experiment as it is.
        grid: How many set-points, which payloads and how long; None leaves the experiment's.
        adaptive: The controller.

    Raises:
        ConfigError: The experiment is no grid of set-points, or the grid leaves nothing of it.
    """
    e = config.experiment
    if e.kind != "dynamic" or not e.setpoints:
        raise ConfigError(f"the benchmark runs dynamic experiments with set-points, and {e.name} is none")
    if grid.setpoints is not None and not 0 < grid.setpoints <= len(e.setpoints):
        raise ConfigError(f"grid.setpoints must be between 1 and {len(e.setpoints)}, got {grid.setpoints}")
    if not (e.payloads if grid.payloads is None else grid.payloads):
        raise ConfigError("grid.payloads must list at least one payload in kg, or be null")
    cut = replace(
        e,
        setpoints=e.setpoints[: grid.setpoints],
        payloads=e.payloads if grid.payloads is None else grid.payloads,
        duration=e.duration if grid.duration is None else grid.duration,
    )
    return replace(config, experiment=cut, controller=replace(config.controller, adaptive=adaptive))


def check_pair(run: str, pair: Pair) -> None:
    """Raises ConfigError where the two controllers would not be given the same task."""
    one, other = pair.standard.experiment, pair.adaptive.experiment
    for key in ("setpoints", "payloads", "duration"):
        if getattr(one, key) != getattr(other, key):
            raise ConfigError(f"both controllers of {run} must have the same experiment.{key}")
    for key in ("arm", "plant"):
        if getattr(pair.standard, key) != getattr(pair.adaptive, key):
            raise ConfigError(f"both controllers of {run} must have the same {key}")


def simulate_all(pairs: Pairs, folder: Path, progress: bool, workers: int = 1) -> dict[str, Outcomes]:
    """Runs every grid, writes its thinned log, and adds the held-out twins and the single runs.

    Args:
        pairs: Settings.
        folder: The benchmark's; logs go to its data/.
        progress: Show bars.
        workers: Processes that share the grids; with one, everything runs in this process.

    Raises:
        ConfigError, ValueRangeError: A setting has no meaning.
    """
    jobs = [(c, run, name) for c, runs in pairs.items() for run in runs for name in CONTROLLERS]
    whole: dict[str, dict[str, dict[str, Outcome]]] = {c: {run: {} for run in runs} for c, runs in pairs.items()}
    tasks = [
        (
            replace(getattr(pairs[c][run], name), progress=progress and workers == 1),
            name == "adaptive",
            f"{run}, {name}",
        )
        for c, run, name in jobs
    ]
    found_all = _outcomes(tasks, workers)
    for index in progress_bar("benchmark, grids", progress)(range(len(jobs))):
        comparison, run, name = jobs[index]
        outcome_of = next(found_all)
        write_arrays(folder / "data" / f"{comparison}_{run}_{name}.npz", outcome_of.log._asdict())
        whole[comparison][run][name] = outcome_of
    results: dict[str, Outcomes] = {}
    for comparison, runs in whole.items():
        extra: dict[str, dict[str, Outcome]] = {}
        for run, both in runs.items():
            extra |= parts(run, both, pairs[comparison][run].standard)
        results[comparison] = {**runs, **extra}
    return results


def _outcomes(tasks: list[tuple[SimulateSettings, bool, str]], workers: int) -> Iterator[Outcome]:
    """The outcome of each task, in order."""
    if workers == 1:
        yield from (outcome(*task) for task in tasks)
        return
    with processes.workers(workers, torch.set_num_threads, torch.get_num_threads()) as pool:
        waiting = deque(pool.submit(outcome, *task) for task in tasks)
        while waiting:
            yield waiting.popleft().result()


def run(config: BenchmarkSettings, pairs: Pairs, folder: Path) -> str:
    """Runs the benchmark and writes its folder; returns the table as text.

    Args:
        config: The benchmark's own settings.
        pairs: The experiments' settings, cut to the grid.
        folder: Where everything goes.

    Raises:
        ConfigError, ValueRangeError: A setting has no meaning.
    """
    started = time.perf_counter()
    if not any(pairs.values()):
        raise ConfigError("grid.comparisons must name at least one run")
    for runs in pairs.values():
        for name, pair in runs.items():
            check_pair(name, pair)
    results = simulate_all(pairs, folder, config.progress, config.workers)
    words = text(results, {name: comparison.about for name, comparison in config.grid.comparisons.items()})
    seeds = {f"{c}_{run}": pair.standard.seed for c, runs in pairs.items() for run, pair in runs.items()}
    write_json(folder / "versions.json", {**versions(), "seeds": seeds})
    write_atomically(folder / "table.txt", words)
    write_json(folder / "table.json", table(results))
    # Last: a folder with metrics is complete.
    write_json(folder / "metrics.json", flat_metrics(results) | {"wall_s": time.perf_counter() - started})
    if config.figures:
        for comparison, outcomes in results.items():
            save_paper_figures(outcomes, folder / "figures" / ("" if comparison == "A" else comparison))
    return words
