"""What `python -m apcc_torch.benchmark` can be set to, with its types. Values and meanings stand in conf/."""

from __future__ import annotations

from dataclasses import dataclass, field

from omegaconf import MISSING


@dataclass
class PairConfig:
    """Experiments that a benchmark's run takes each controller's settings from."""

    standard: str = MISSING
    adaptive: str = MISSING


@dataclass
class ComparisonConfig:
    """Runs under one idea of which settings to compare, and that idea in words."""

    about: str = ""
    runs: dict[str, PairConfig] = field(default_factory=dict)


@dataclass
class GridConfig:
    """What the benchmark runs, and how much of each run."""

    name: str = MISSING
    comparisons: dict[str, ComparisonConfig] = field(default_factory=dict)
    setpoints: int | None = None
    payloads: list[float] | None = None
    duration: float | None = None


@dataclass
class OverridesConfig:
    """Overrides of the experiments' settings: of both controllers, and of one."""

    common: list[str] = field(default_factory=list)
    standard: list[str] = field(default_factory=list)
    adaptive: list[str] = field(default_factory=list)


@dataclass
class BenchmarkConfig:
    """Root of `python -m apcc_torch.benchmark`."""

    grid: GridConfig = field(default_factory=GridConfig)
    experiments: OverridesConfig = field(default_factory=OverridesConfig)
    workers: int = 2
    threads: int | None = 1
    figures: bool = True
    progress: bool = True
