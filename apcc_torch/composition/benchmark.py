"""What `python -m apcc_torch.benchmark` can be set to."""

from __future__ import annotations

from dataclasses import dataclass

from apcc_torch.composition.run_settings import FolderSettings
from apcc_torch.settings import OURS, Settings, setting


@dataclass(frozen=True, kw_only=True)
class PairSettings(Settings):
    """Experiments that a benchmark's run takes each controller's settings from."""

    standard: str = setting(meaning="experiment of the standard controller")
    adaptive: str = setting(meaning="experiment of the adaptive controller")
    common: tuple[str, ...] = setting(
        (), meaning="settings of every row of this run, as apcc_torch.simulate takes them"
    )
    changes: dict[str, tuple[str, ...]] = setting(factory=dict, meaning="row: settings that it has in this run alone")


@dataclass(frozen=True, kw_only=True)
class RowSettings(Settings):
    """One row of a comparison in which nothing but the law differs."""

    about: str = setting("", meaning="what it is")
    settings: tuple[str, ...] = setting((), meaning="the law, as apcc_torch.simulate takes it")
    searched: str | None = setting(
        None,
        meaning="what is searched for on the training set-points with the true shape known: lengths, constant rest "
        "lengths; gamma, of Eq. (15); null: nothing",
        choices=("lengths", "gamma"),
    )


@dataclass(frozen=True, kw_only=True)
class ComparisonSettings(Settings):
    """Runs under one idea of which settings to compare, and that idea in words."""

    about: str = setting("", meaning="the idea")
    runs: dict[str, PairSettings] = setting(factory=dict, meaning="name: the experiments of its two controllers")
    common: tuple[str, ...] = setting((), meaning="settings of every row, as apcc_torch.simulate takes them")
    rows: dict[str, RowSettings] = setting(
        factory=dict, meaning="name: a row that differs in its law alone; none: standard and adaptive, fixed and not"
    )


@dataclass(frozen=True, kw_only=True)
class GridSettings(Settings):
    """What the benchmark runs, and how much of each run."""

    name: str = setting(meaning="of the grid")
    comparisons: dict[str, ComparisonSettings] = setting(factory=dict, meaning="name: runs under one idea")
    setpoints: int | None = setting(None, "", OURS, "how many of each experiment's set-points; null: all", least=1)
    payloads: tuple[float, ...] | None = setting(
        None, "kg", OURS, "instead of each experiment's; null: as they are", least=0, most=1000
    )
    duration: float | None = setting(None, "s", OURS, "instead of each experiment's; null: as it is", above=0)


@dataclass(frozen=True, kw_only=True)
class OverrideSettings(Settings):
    """Settings of the experiments to change, as apcc_torch.simulate takes them."""

    common: tuple[str, ...] = setting((), meaning="for both controllers")
    standard: tuple[str, ...] = setting((), meaning="for the standard controller alone")
    adaptive: tuple[str, ...] = setting((), meaning="for the adaptive controller alone")


@dataclass(frozen=True, kw_only=True)
class BenchmarkSettings(FolderSettings):
    """Root of `python -m apcc_torch.benchmark`."""

    grid: GridSettings = setting(meaning="what is run")
    experiments: OverrideSettings = setting(factory=OverrideSettings, meaning="settings of the experiments to change")
    workers: int = setting(2, "", OURS, "processes that share the grids", least=1, most=1024)
    threads: int | None = setting(
        1,
        "",
        OURS,
        "a process's torch threads; small batches run fastest on one; null: torch's choice",
        least=1,
        most=1024,
    )
    figures: bool = setting(True, "", OURS, "draw the figures and the films")
    progress: bool = setting(True, "", OURS, "show progress bars where there is a terminal")
