"""One run of a configuration: settings in, a folder of results out."""

from __future__ import annotations

import math
import shutil
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

import torch
from omegaconf import DictConfig

from apcc_torch.composition.run_settings import SimulateSettings
from apcc_torch.composition.schema import text, typed
from apcc_torch.errors import ConfigError
from apcc_torch.experiments.folder import versions
from apcc_torch.experiments.kinds import KINDS, Kind, kind_of
from apcc_torch.files import json_in, read_text, write_atomically, write_json
from apcc_torch.reading import plain

METRICS, PRUNED = "metrics.json", "pruned.json"


def settings_of(cfg: DictConfig, folder: Path) -> SimulateSettings:
    """Checks a composed configuration and leaves it, resolved, in the run's folder as config.yaml.

    Raises:
        ConfigError: A value is missing or of the wrong type.
    """
    config = typed(cfg, SimulateSettings)
    write_atomically(folder / "config.yaml", text(config))
    return config


def run(config: SimulateSettings, folder: Path) -> dict[str, float]:
    """Runs the configured experiment into `folder`; its last file is metrics.json, or pruned.json.

    With `prune.after` the run is first tried for that long. Where a row diverges, or the objective is above
    `prune.above`, the whole run is not worth its time: pruned.json says so, and holds the metrics of the try.

    Returns:
        The metrics: of the whole run, or of the try if the run was pruned.

    Raises:
        ConfigError, ValueRangeError: A setting has no meaning.
    """
    if config.threads is not None:
        torch.set_num_threads(config.threads)
    experiment = kind_of(config, KINDS)
    after = config.prune.after
    if after is not None:
        if not 0 < after < config.experiment.duration:
            raise ConfigError(f"prune.after must be between 0 and experiment.duration, got {after}")
        metrics = _tried(experiment, config, folder / "try", after)
        why = _why_pruned(metrics, config)
        if why is not None:
            write_json(folder / "versions.json", {**versions(), "seed": config.seed})
            write_json(folder / PRUNED, {"why": why, **pruning(config), "metrics": metrics})
            return metrics
    return experiment.run(config, folder)


def pruning(config: SimulateSettings) -> dict[str, object]:
    """The settings that decide which runs are pruned."""
    return {"objective": config.objective, **plain(config.prune)}


def objective_value(metrics: Mapping[str, float], name: str) -> float:
    """The metric that a search lowers: infinite where a row diverged or the metric is not finite.

    Raises:
        ConfigError: There is no such metric.
    """
    if name not in metrics:
        raise ConfigError(f"objective must be one of {', '.join(metrics)}, got {name!r}")
    value = metrics[name]
    return value if math.isfinite(value) and not metrics.get("diverged_rows") else math.inf


def objective_in(folder: Path, name: str | None) -> float | None:
    """The objective of a finished run's folder: infinite for a pruned run, None if no objective is named.

    Raises:
        ConfigError: There is no such metric.
    """
    if name is None:
        return None
    if (folder / PRUNED).is_file():
        return math.inf
    return objective_value(json_in(read_text(folder / METRICS), METRICS), name)


def _tried(experiment: Kind, config: SimulateSettings, folder: Path, after: float) -> dict[str, float]:
    """Metrics of the first `after` seconds; leaves no file."""
    short = replace(config, figures=False, experiment=replace(config.experiment, duration=after))
    try:
        return experiment.run(short, folder)
    finally:
        shutil.rmtree(folder, ignore_errors=True)


def _why_pruned(metrics: Mapping[str, float], config: SimulateSettings) -> str | None:
    if metrics.get("diverged_rows"):
        return f"{metrics['diverged_rows']:.0f} of {metrics['rows']:.0f} rows diverged within {config.prune.after} s"
    if config.prune.above is None:
        return None
    if config.objective is None:
        raise ConfigError("prune.above needs an objective")
    value = objective_value(metrics, config.objective)
    if value <= config.prune.above:
        return None
    return f"{config.objective} is {value:.4g} after {config.prune.after} s, above {config.prune.above:g}"
