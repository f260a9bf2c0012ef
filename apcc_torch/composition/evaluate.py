"""What `python -m apcc_torch.evaluate` can be set to, and the recordings that it means."""

from __future__ import annotations

from dataclasses import dataclass

import torch

from apcc_torch.composition.identify import LearningSettings, of_the_arm
from apcc_torch.errors import ConfigError, DataError
from apcc_torch.evaluation.frames import Frames
from apcc_torch.evaluation.leaderboard import Session
from apcc_torch.evaluation.methods import METHODS
from apcc_torch.identification.series import read_series
from apcc_torch.identification.split import split
from apcc_torch.recordings.data_set import DataSettings, located
from apcc_torch.settings import MANY, OURS, did_you_mean, setting


@dataclass(frozen=True, kw_only=True)
class EvaluateSettings(LearningSettings):
    """Root of `python -m apcc_torch.evaluate`."""

    data: DataSettings = setting(factory=DataSettings, meaning="the recordings")
    methods: tuple[str, ...] = setting((), "", OURS, "rows of the leaderboard; empty: all")
    every: int = setting(10, "", OURS, "of the moments to be scored each so many-th is", least=1, most=MANY)
    seed: int = setting(0, "", OURS, "of methods that draw random numbers", least=0, most=2**32 - 1)

    def check(self) -> None:
        """Raises ConfigError where there is no such method."""
        for name in self.methods:
            if name not in METHODS:
                raise ConfigError(f"methods has no {name!r}{did_you_mean(name, METHODS)}")


def recordings(settings: EvaluateSettings) -> tuple[list[Session], Frames | None]:
    """The sessions, and the moments at which the arm rests straight, if there are some.

    Raises:
        ConfigError: There is no session, or the arm is not that of the recordings.
        DataError: A file cannot be had or read, or is too short to be split.
    """
    data, fit = settings.data, settings.fit
    data.learned  # noqa: B018  raises where there is none
    folder = located(data, settings.data_root)
    folds = range(settings.split.folds) if data.every_fold else [settings.split.fold]
    sessions = []
    for name, each in data.sessions.items():
        series = of_the_arm(read_series(folder / each.file, settings.recording), settings.arm)
        try:
            parts = [split(series.groups, settings.split, fold=fold) for fold in folds]
        except DataError as error:
            raise DataError(f"{series.source}: {error}") from error
        sessions.append(Session(name, each.payload, Frames.of(series, fit.history, fit.slide_travel), parts))
    if data.rest is None:
        return sessions, None
    rest = of_the_arm(read_series(folder / data.rest, settings.recording), settings.arm)
    still = Frames.of(rest)
    return sessions, still if data.rest_frames is None else still.at(torch.arange(min(data.rest_frames, len(still))))
