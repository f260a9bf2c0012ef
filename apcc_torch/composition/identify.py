"""What `python -m apcc_torch.identify` can be set to, and what is made of it. Values and meanings stand in conf/."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import torch
from omegaconf import MISSING
from torch import Tensor

from apcc_torch.errors import ConfigError, DataError
from apcc_torch.identification.parameters import Block, Parameters
from apcc_torch.identification.series import Series, read_series, series_of
from apcc_torch.identification.tendon_arm import Layout, block_sizes
from apcc_torch.recordings.recording import detect_layout, load_recording


@dataclass
class TableConfig:
    """How the recording is read."""

    layout: str = "table"
    inputs: list[str] = field(default_factory=list)
    bodies: list[Any] = field(default_factory=list)
    unit: float = 1.0
    time: str | None = None
    rate: float = 100.0
    group: str | None = None
    group_ending: str = ""


@dataclass
class TendonsConfig:
    """How the tendons run and what drives them; one entry a tendon."""

    inputs: list[int] = MISSING
    pulls: list[float] = MISSING
    ends: list[int] = MISSING


@dataclass
class BlockConfig:
    """Parameters of one kind: one number for all, or one each."""

    nominal: Any = MISSING
    spread: Any = 0.0


@dataclass
class SplitConfig:
    """What is held back."""

    by: str = "blocks"
    folds: int = 5
    fold: int = 4


@dataclass
class FitConfig:
    """How the fits are done."""

    samples: int = 400
    steps: int = 25
    rounds: int = 3
    history: int = 1
    slide_travel: float = 0.0
    geometric: list[str] = field(default_factory=list)
    online_samples: int = 1000
    online_noise: float = 0.01
    online_walk: float = 0.03


@dataclass
class IdentifyConfig:
    """Root of `python -m apcc_torch.identify`."""

    name: str = MISSING
    data: str | None = None
    recording: TableConfig = field(default_factory=TableConfig)
    masses: list[float] = MISSING
    bodies: list[int] = MISSING
    tendons: TendonsConfig = field(default_factory=TendonsConfig)
    blocks: dict[str, BlockConfig] = field(default_factory=dict)
    split: SplitConfig = field(default_factory=SplitConfig)
    fit: FitConfig = field(default_factory=FitConfig)
    figures: bool = True
    progress: bool = True
    threads: int | None = 1


def read(config: IdentifyConfig) -> Series:
    """The recording that `data` names.

    Raises:
        ConfigError: No data is named, or the layout is unknown.
        DataError: The recording cannot be read, or does not have what the arm has.
    """
    r = config.recording
    if config.data is None:
        raise ConfigError("data must name the file or folder of a recording: data=PATH")
    if r.layout not in ("table", "columns", "trunk", "auto"):
        raise ConfigError(f"recording.layout must be table, columns, trunk or auto, got {r.layout!r}")
    if r.layout == "table":
        series = read_series(config.data, r.inputs, r.bodies, r.unit, r.time, r.rate, r.group, r.group_ending)
    else:
        layout = detect_layout(config.data) if r.layout == "auto" else r.layout
        series = series_of(load_recording(config.data, layout=layout, rate=r.rate))
    return series


def layout(config: IdentifyConfig, series: Series) -> Layout:
    """What is known of the arm, checked against the recording.

    Raises:
        ConfigError: Settings do not fit each other, or not the recording.
    """
    t = config.tendons
    arm = Layout(
        len(config.masses), tuple(t.inputs), tuple(t.pulls), tuple(t.ends), tuple(config.bodies), tuple(config.masses)
    )
    m, k = series.inputs.shape[-1], series.positions.shape[1]
    if arm.n_inputs > m:
        raise ConfigError(f"tendons.inputs names input {arm.n_inputs - 1}, the recording has {m}, numbered from 0")
    if len(arm.bodies) != k:
        raise ConfigError(f"bodies has {len(arm.bodies)} entries, the recording has {k} bodies")
    return arm


def _numbers(key: str, value: Any, count: int) -> Tensor:
    """One number a parameter, from one for all or a list."""
    given = list(value) if isinstance(value, Sequence) and not isinstance(value, str) else [value]
    try:
        numbers = torch.tensor([float(v) for v in given], dtype=torch.float64)
    except (TypeError, ValueError) as error:
        raise ConfigError(f"{key} must be a number or a list of {count}, got {value!r}") from error
    if len(numbers) not in (1, count):
        raise ConfigError(f"{key} must be a number or a list of {count}, got {len(numbers)} entries")
    return numbers.expand(count).clone()


def parameters(config: IdentifyConfig, arm: Layout) -> Parameters:
    """The blocks of an arm.

    Raises:
        ConfigError: A block is missing or unknown, or has the wrong number of entries.
    """
    sizes = block_sizes(arm)
    for name in config.blocks:
        if name not in sizes:
            raise ConfigError(f"blocks.{name} is not a block; there are {', '.join(sizes)}")
    blocks = {}
    for name, (unit, logarithmic, labels) in sizes.items():
        if name not in config.blocks:
            raise ConfigError(f"blocks.{name} is missing")
        given, key = config.blocks[name], f"blocks.{name}"
        nominal = _numbers(f"{key}.nominal", given.nominal, len(labels))
        spread = _numbers(f"{key}.spread", given.spread, len(labels))
        blocks[name] = Block(nominal, spread, unit, tuple(labels), logarithmic)
    return Parameters(blocks)


def arm_of(data: str) -> str:
    """The arm of conf/arm that a recording is of, by its layout or its columns.

    Raises:
        ConfigError: It is of none of them.
        DataError: It cannot be read.
    """
    path = Path(data)
    if not path.exists():
        raise DataError(f"{path}: there is no such file or folder")
    file = path / "recording.csv" if path.is_dir() else path
    if file.is_file():
        with file.open(encoding="utf-8-sig", errors="replace") as lines:
            header = {name.strip() for name in lines.readline().split(",")}
        if {"servo_1_mm", "tip_x"} <= header:
            return "ftdcr_v6"
    if detect_layout(path) == "trunk":
        return "trunk"
    raise ConfigError(f"arm must be named: arm=NAME, as {path} is of no arm in conf/arm")
