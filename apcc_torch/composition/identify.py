"""What `python -m apcc_torch.identify` can be set to, and what is made of it."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import torch

from apcc_torch.composition.run_settings import FolderSettings
from apcc_torch.composition.unread import Unread
from apcc_torch.errors import ConfigError, DataError
from apcc_torch.identification.arm_blocks import KEYS, Spreads, arm_parameters
from apcc_torch.identification.fit import FitSettings
from apcc_torch.identification.online import OnlineSettings
from apcc_torch.identification.parameters import Parameters
from apcc_torch.identification.series import Series, joined, series_of
from apcc_torch.identification.split import Split, SplitSettings, split
from apcc_torch.model.arm import Arm
from apcc_torch.recordings.data_set import DataSettings, located, named_set, refuse, set_names
from apcc_torch.recordings.declaration import RecordingSettings
from apcc_torch.recordings.recording_file import detect_layout
from apcc_torch.recordings.session_file import load_session
from apcc_torch.settings import MANY, OURS, check_choice, names, setting

MOST_HEADER = 2**20
"""Characters of a recording's first line that are looked at."""
GEOMETRY = (
    "rest_length",
    "angle",
    "offset",
    "input_scale",
    "pre_stretch",
    "damping_ratio",
    "base_position",
    "base_rotation",
    "mount",
)
"""Blocks that tell where an arm is whose bends follow from its tendons' lengths."""

OF_LENGTHS = ("pre_stretch", "tendon_stiffness")
"""Blocks that say what tension a length makes."""


@dataclass(frozen=True, kw_only=True)
class ArmFitSettings(FitSettings):
    """How the arm is fitted to the training samples."""

    samples: int = setting(400, "", OURS, "training samples that the fits see, evenly spread", least=2)
    history: int = setting(
        1, "", OURS, "inputs that matter, from now back; 1 for an arm at rest in every sample", least=1, most=MANY
    )
    slide_travel: float = setting(
        0.0, "", OURS, "travel of an input in which friction turns over, in its unit; 0: no friction", least=0
    )
    geometric: tuple[str, ...] = setting(GEOMETRY, "", OURS, "spreads that the PCC geometry is fitted with")

    def check(self) -> None:
        """Raises ConfigError where there is no such spread."""
        for name in self.geometric:
            check_choice("geometric", name, names(Spreads))


@dataclass(frozen=True, kw_only=True)
class ArmOnlineSettings(OnlineSettings):
    """How the PCC geometry is adapted online."""

    samples: int = setting(1000, "", OURS, "samples that it sees, evenly spread", least=1)


@dataclass(frozen=True, kw_only=True)
class LearningSettings(FolderSettings):
    """What every program has that fits an arm to recordings."""

    data: DataSettings = setting(factory=DataSettings, meaning="the recordings: data=NAME, data=FILE, data=FOLDER")
    arm: Arm = setting(meaning="what is believed of the arm: a name in conf/arm, or an arm's file")
    spread: Spreads = setting(factory=Spreads, meaning="how far the arm may be from that")
    recording: RecordingSettings = setting(factory=RecordingSettings, meaning="how the recording is read")
    split: SplitSettings = setting(factory=SplitSettings, meaning="what is held back")
    fit: ArmFitSettings = setting(factory=ArmFitSettings, meaning="how the arm is fitted")
    data_root: str | None = setting(
        None, "", OURS, "folder that holds the data sets of conf/data_set; null: APCC_DATA, else they are fetched"
    )
    figures: bool = setting(True, "", OURS, "whether figures are drawn")
    progress: bool = setting(True, "", OURS, "whether rounds are told as they end")
    threads: int | None = setting(1, "", OURS, "torch threads; null leaves torch its choice", least=1, most=1024)


@dataclass(frozen=True, kw_only=True)
class IdentifySettings(LearningSettings):
    """Root of `python -m apcc_torch.identify`."""

    online: ArmOnlineSettings = setting(factory=ArmOnlineSettings, meaning="how the geometry is adapted online")


def of_a_fit(settings: LearningSettings) -> Unread:
    """What an identification does not read."""
    # A spread of zero says that nothing is fitted, and nothing is.
    if settings.fit.slide_travel == 0 and settings.spread.friction:
        yield "spread.friction", "fit.slide_travel is zero, there is no friction"
    if settings.fit.history == 1 and settings.spread.damping_ratio:
        yield "spread.damping_ratio", "fit.history is 1, the arm is at rest in every sample"
    if settings.arm.actuation.sets == "tension":
        for name in OF_LENGTHS:
            yield f"spread.{name}", "arm.actuation.sets is tension, no length is told"
        yield "fit.geometric", "arm.actuation.sets is tension, no length is told"


def recorded(settings: LearningSettings) -> tuple[Series, Split]:
    """The recording that `data` means, which has what the arm has, and which of its samples judge the fit.

    Raises:
        ConfigError: No data is named, or the arm is not that of the recording.
        DataError: The recording cannot be read, or is not what it is declared to be.
    """
    data, arm = settings.data, settings.arm
    learned = data.in_motion().learned
    folder = located(data, settings.data_root)

    def read(name: str) -> Series:
        return of_the_arm(series_of(load_session(folder, data.sessions[name], settings.recording, arm)), arm)

    series = read(learned)
    if not data.validation:
        return series, split(series.groups, settings.split).within(series.seen)
    both = joined(series, read(data.validation))
    index = torch.arange(len(both))
    return both, Split(index[: len(series)], index[len(series) :]).within(both.seen)


def of_the_arm(series: Series, arm: Arm) -> Series:
    """The recording, if it has what the arm has.

    Raises:
        ConfigError: The arm is not that of the recording.
    """
    m, k = series.inputs.shape[-1], series.positions.shape[1]
    last, sensors = max(arm.actuation.driving(arm.n_tendons)), len(arm.sensor_places())
    if last >= m:
        raise ConfigError(f"arm.actuation.inputs names input {last}, the recording has {m}, numbered from 0")
    if sensors != k:
        raise ConfigError(f"arm.sensors must name {k} places, one a body of the recording, got {sensors}")
    return series


def parameters(settings: LearningSettings) -> Parameters:
    """What is fitted of the arm.

    Raises:
        ConfigError: A spread has the wrong number of entries, all are zero, or what is known by its ratio is.
    """
    arm, spread = settings.arm, settings.spread
    # A spread of zero says that nothing is fitted, and nothing is.
    if settings.fit.slide_travel == 0 and settings.spread.friction:
        spread = spread.changed(friction=0.0)
    if settings.fit.history == 1 and settings.spread.damping_ratio:
        spread = spread.changed(damping_ratio=0.0)
    if arm.actuation.sets == "tension":
        spread = spread.changed(**dict.fromkeys(OF_LENGTHS, 0.0))
    for name, value in {"friction": arm.actuation.friction, "damping_ratio": arm.damping_ratio}.items():
        if getattr(spread, name) and not value:
            raise ConfigError(f"arm.{KEYS[name]} must be positive to be fitted by its ratio; spread.{name}=0 holds it")
    blocks = arm_parameters(arm, spread)
    if not len(blocks):
        raise ConfigError("spread: every one is zero, so there is nothing to fit")
    return blocks


def known_arm(data: str) -> str | None:
    """The arm of conf/arm that a recording is of, by its set, its layout or its columns; None where it is of none.

    Raises:
        ConfigError: It is the name of no data set, and close to one.
        DataError: There is no such file.
    """
    path = Path(data)
    if data in set_names():
        return named_set(data).arm
    if not path.exists():
        refuse(data)
    file = path / "recording.csv" if path.is_dir() else path
    if file.is_file():
        try:
            with file.open(encoding="utf-8-sig", errors="replace") as lines:
                header = {name.strip() for name in lines.readline(MOST_HEADER).split(",")}
        except OSError as error:
            raise DataError(f"{file}: cannot be read: {error.strerror}") from error
        if {"servo_1_mm", "tip_x"} <= header:
            return "ftdcr_v6"
    return "trunk" if detect_layout(path) == "trunk" else None
