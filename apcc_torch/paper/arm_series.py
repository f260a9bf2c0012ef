"""What `python -m apcc_torch.robot` runs: one experiment on an arm, a calibration, or a series with its study."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path

from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException

from apcc_torch.composition.realtime import RealtimeSettings
from apcc_torch.composition.schema import text, typed
from apcc_torch.errors import ConfigError
from apcc_torch.experiments import calibrate as arm_calibration
from apcc_torch.experiments import realtime_run as realtime
from apcc_torch.experiments.folder import versions
from apcc_torch.files import write_atomically, write_json
from apcc_torch.hardware.records import Outcome
from apcc_torch.hardware.stops import StopReason
from apcc_torch.paper import mapping_study, state_feedback_study
from apcc_torch.paper.tendon_samples import sampled_runs
from apcc_torch.plain_text import plain_logger
from apcc_torch.report.style import Draw, save_figures
from apcc_torch.settings import check_choice

log = plain_logger(__name__)

Study = Callable[[Path, Sequence[str]], tuple[dict[str, float], dict[str, Draw]]]
"""Writes the tables of a series; returns its metrics, and what draws its figures."""
STUDIES: Mapping[str, Study] = {"experiment_1": state_feedback_study.study, "experiment_2": mapping_study.study}
RAN = (StopReason.ARRIVED, StopReason.DURATION, StopReason.DIVERGENCE)
"""Ends after which the next run of a series may begin; the others need someone to look at the arm."""


def run(cfg: DictConfig, folder: Path) -> tuple[Outcome, dict[str, float]]:
    """Runs the settings into `folder`; returns how it ended, and its metrics.

    Raises:
        ConfigError, ValueRangeError, DataError: A setting has no meaning.
        HardwareError: The priority or memory that was asked for is refused.
    """
    settings = typed(cfg, RealtimeSettings)
    write_atomically(folder / realtime.CONFIG, text(settings))
    if runs_of(settings):
        return series(cfg, settings, folder)
    if settings.experiment.kind == arm_calibration.KIND:
        return arm_calibration.run(settings, folder)
    return realtime.run(settings, folder)


def planned(cfg: DictConfig) -> list[RealtimeSettings]:
    """The settings of every run of a series, with their own above the series'; of one run its own.

    Raises:
        ConfigError, ValueRangeError: A setting has no meaning.
    """
    settings = typed(cfg, RealtimeSettings)
    runs = [typed(_changed(cfg, changes), RealtimeSettings) for changes in runs_of(settings).values()]
    # Each is one of the series, which reads its own keys.
    return [run.changed(series=settings.series) for run in runs] or [settings]


def runs_of(settings: RealtimeSettings) -> Mapping[str, Sequence[str]]:
    """A series' runs: name -> what differs in that run; none of a run that is no series."""
    s = settings.series
    return sampled_runs(settings.arm, s.sampled, settings.seed) if s.sampled else s.runs


def series(cfg: DictConfig, settings: RealtimeSettings, folder: Path) -> tuple[Outcome, dict[str, float]]:
    """Every run in a folder of its own, and then the study of those that came to their end."""
    s = settings.series
    if s.study is not None:
        check_choice("series.study", s.study, tuple(STUDIES))
    runs = runs_of(settings)
    names = list(runs) if s.only is None else s.only
    for name in names:
        check_choice("series.only", name, tuple(runs))
    done: list[str] = []
    outcome: Outcome | None = None
    for name in names:
        outcome, metrics = run(_changed(cfg, runs[name]), folder / name)
        if not metrics or outcome.reason not in RAN:
            return outcome, {}
        log.info("%s: %s: %s", name, outcome.reason.value, outcome.message)
        done.append(name)
    if outcome is None:
        raise ConfigError("series.only must name at least one run")
    metrics, drawings = ({}, {}) if s.study is None else STUDIES[s.study](folder, done)
    metrics["runs"] = float(len(done))
    write_json(folder / "versions.json", {**versions(), "seed": settings.seed})
    write_json(folder / "metrics.json", metrics)
    if s.figures:
        save_figures(drawings, folder / "figures")
    return replace(outcome, reason=StopReason.COMPLETED, message=f"{len(done)} runs are in {folder}"), metrics


def _changed(cfg: DictConfig, overrides: Sequence[str]) -> DictConfig:
    """The settings of one run of a series."""
    try:
        changed = OmegaConf.merge(cfg, OmegaConf.from_dotlist(list(overrides)))
    except OmegaConfBaseException as error:
        raise ConfigError(f"series.runs: {str(error).splitlines()[0]}") from error
    assert isinstance(changed, DictConfig)  # what merging settings gives
    changed.series.runs, changed.series.sampled, changed.figures = {}, 0, False  # the study has figures of its own
    return changed
