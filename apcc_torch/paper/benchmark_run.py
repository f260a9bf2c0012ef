"""Section V-B and Appendix A whole: every run with both controllers, one table beside the paper's, and its figures."""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Iterator, Mapping
from dataclasses import replace
from pathlib import Path

import torch

from apcc_torch import processes
from apcc_torch.composition.benchmark import BenchmarkSettings, GridSettings
from apcc_torch.composition.run_settings import SimulateSettings
from apcc_torch.errors import ConfigError
from apcc_torch.experiments.folder import progress_bar, versions
from apcc_torch.files import write_arrays, write_atomically, write_json
from apcc_torch.paper.comparison_table import flat_metrics, table, text
from apcc_torch.paper.figures import save_law_figure, save_paper_figures
from apcc_torch.paper.outcomes import HELD_OUT, SINGLE, Outcome, Outcomes, Row, outcome, parts
from apcc_torch.settings import check_names, names

CONTROLLERS = ("standard", "adaptive")
"""Rows that every run has."""
Grids = Mapping[str, Mapping[str, Mapping[str, Row]]]
"""Comparison -> run -> row, a controller or a law -> its settings."""


def on_grid(config: SimulateSettings, grid: GridSettings, adaptive: bool | None) -> SimulateSettings:
    """An experiment's settings cut to the benchmark's grid, for one controller.

    Args:
        config: The experiment as it is.
        grid: How many set-points, which payloads and how long; None leaves the experiment's.
        adaptive: The controller; None for the experiment's.

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
    adaptive = config.controller.adaptive if adaptive is None else adaptive
    return replace(config, experiment=cut, controller=replace(config.controller, adaptive=adaptive))


def check_rows(run: str, rows: Mapping[str, Row]) -> None:
    """Raises ConfigError where the controllers of a run would not be given the same task."""
    check_names(f"run {run}", CONTROLLERS, tuple(rows))
    first = rows["standard"].config
    for other in (row.config for row in rows.values()):
        for key in ("setpoints", "payloads", "duration"):
            if getattr(first.experiment, key) != getattr(other.experiment, key):
                raise ConfigError(f"both controllers of {run} must have the same experiment.{key}")
        for key in ("arm", "plant"):
            if getattr(first, key) != getattr(other, key):
                raise ConfigError(f"both controllers of {run} must have the same {key}")


def check_laws(run: str, rows: Mapping[str, Row]) -> None:
    """Raises ConfigError where the rows of a run differ in more than their law."""

    def shared(config: SimulateSettings) -> SimulateSettings:
        return config.changed(adaptation=None, controller=config.controller.changed(adaptive=True))

    kept = {name: shared(row.config) for name, row in rows.items()}
    for name, config in kept.items():
        for key in names(SimulateSettings):
            if getattr(config, key) != getattr(kept["standard"], key):
                raise ConfigError(f"only the law may differ between the rows of {run}, but {name} has another {key}")


def simulate_all(grids: Grids, folder: Path, progress: bool, workers: int = 1) -> dict[str, Outcomes]:
    """Runs every grid, writes its thinned log, and adds the held-out twins and the single runs.

    Args:
        grids: Settings.
        folder: The benchmark's; logs go to its data/.
        progress: Show bars.
        workers: Processes that share the grids; with one, everything runs in this process.

    Raises:
        ConfigError, ValueRangeError: A setting has no meaning.
    """
    jobs = [(c, run, name) for c, runs in grids.items() for run, rows in runs.items() for name in rows]
    whole: dict[str, dict[str, dict[str, Outcome]]] = {c: {run: {} for run in runs} for c, runs in grids.items()}
    tasks = []
    for c, run, name in jobs:
        row = grids[c][run][name]
        shown = row._replace(config=replace(row.config, progress=progress and workers == 1))
        # Where laws stand beside each other, constants in hindsight say what there is to win.
        limited = len(grids[c][run]) == len(CONTROLLERS)
        tasks.append((shown, limited, f"{c}, {run}, {name}"))
    found_all = _outcomes(tasks, workers)
    for index in progress_bar("benchmark, grids", progress)(range(len(jobs))):
        comparison, run, name = jobs[index]
        outcome_of = next(found_all)
        write_arrays(folder / "data" / f"{comparison}_{run}_{name}.npz", outcome_of.log._asdict())
        whole[comparison][run][name] = outcome_of
    results: dict[str, Outcomes] = {}
    for comparison, runs in whole.items():
        extra: dict[str, dict[str, Outcome]] = {}
        for run, rows in runs.items():
            extra |= parts(run, rows, grids[comparison][run]["standard"].config)
        results[comparison] = {**runs, **extra}
    return results


def _outcomes(tasks: list[tuple[Row, bool, str]], workers: int) -> Iterator[Outcome]:
    """The outcome of each task, in order."""
    if workers == 1:
        yield from (outcome(*task) for task in tasks)
        return
    with processes.workers(workers, torch.set_num_threads, torch.get_num_threads()) as pool:
        waiting = deque(pool.submit(outcome, *task) for task in tasks)
        while waiting:
            yield waiting.popleft().result()


def run(config: BenchmarkSettings, grids: Grids, folder: Path) -> str:
    """Runs the benchmark and writes its folder; returns the table as text.

    Args:
        config: The benchmark's own settings.
        grids: The experiments' settings, cut to the grid.
        folder: Where everything goes.

    Raises:
        ConfigError, ValueRangeError: A setting has no meaning.
    """
    started = time.perf_counter()
    if not any(grids.values()):
        raise ConfigError("grid.comparisons must name at least one run")
    for runs in grids.values():
        for name, rows in runs.items():
            check_rows(name, rows)
    results = simulate_all(grids, folder, config.progress, config.workers)
    comparisons = config.grid.comparisons
    laws = {name: {row: law.about for row, law in c.rows.items()} for name, c in comparisons.items() if c.rows}
    words = text(results, {name: comparison.about for name, comparison in comparisons.items()}, laws)
    seeds = {f"{c}_{run}": rows["standard"].config.seed for c, runs in grids.items() for run, rows in runs.items()}
    write_json(folder / "versions.json", {**versions(), "seeds": seeds})
    write_atomically(folder / "table.txt", words)
    write_json(folder / "table.json", table(results))
    write_json(folder / "searched.json", searched(results))
    # Last: a folder with metrics is complete.
    write_json(folder / "metrics.json", flat_metrics(results) | {"wall_s": time.perf_counter() - started})
    if config.figures:
        for comparison, outcomes in results.items():
            into = folder / "figures" / ("" if comparison == "A" else comparison)
            if comparison in laws:
                save_law_figure(outcomes, laws[comparison], into)
            else:
                save_paper_figures(outcomes, into)
    return words


def searched(results: Mapping[str, Outcomes]) -> dict[str, dict[str, dict[str, dict[str, object]]]]:
    """{comparison: {run: {row: what was searched for it}}}, where something was."""
    return {
        comparison: {
            run: {name: o.found._asdict() for name, o in rows.items() if o.found is not None}
            for run, rows in outcomes.items()
            if not run.endswith((HELD_OUT, SINGLE)) and any(o.found is not None for o in rows.values())
        }
        for comparison, outcomes in results.items()
    }
