"""What `python -m apcc_torch.evaluate` can be set to, and the recordings that it means."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import torch

from apcc_torch.composition.identify import LearningSettings, of_the_arm
from apcc_torch.errors import ConfigError, DataError
from apcc_torch.evaluation.frames import Frames
from apcc_torch.evaluation.leaderboard import Session
from apcc_torch.evaluation.methods import METHODS
from apcc_torch.identification.series import Series, series_of
from apcc_torch.identification.split import Split, split
from apcc_torch.recordings.data_set import located
from apcc_torch.recordings.session_file import load_rest, load_session
from apcc_torch.settings import MANY, OURS, did_you_mean, setting


@dataclass(frozen=True, kw_only=True)
class EvaluateSettings(LearningSettings):
    """Root of `python -m apcc_torch.evaluate`."""

    methods: tuple[str, ...] = setting((), "", OURS, "rows of the leaderboard; empty: all")
    every: int = setting(10, "", OURS, "of the moments to be scored each so many-th is", least=1, most=MANY)
    seed: int = setting(0, "", OURS, "of methods that draw random numbers", least=0, most=2**32 - 1)

    def check(self) -> None:
        """Raises ConfigError where there is no such method."""
        for name in self.methods:
            if name not in METHODS:
                raise ConfigError(f"methods has no {name!r}{did_you_mean(name, METHODS)}")


def recordings(
    settings: EvaluateSettings, tell: Callable[[str, DataError], None] | None = None
) -> tuple[list[Session], Frames | None]:
    """The sessions, and the moments at which the arm rests straight, if there are some.

    Args:
        settings: What is evaluated.
        tell: Takes the name of a session that cannot be read, and why: the others go on. None, and the session that is
            learned from: it is raised.

    Raises:
        ConfigError: There is no session, or the arm is not that of the recordings.
        DataError: A file cannot be had or read, or is too short to be split.
    """
    data, fit, arm = settings.data, settings.fit, settings.arm
    chosen = {name: each for name, each in data.sessions.items() if not data.validation}
    for name in (data.learned, data.validation):
        if data.validation:
            chosen[name] = data.sessions[name]
    folder = located(data, settings.data_root)
    sessions = []
    for name, each in chosen.items():
        try:
            series = of_the_arm(series_of(load_session(folder, each, settings.recording, arm)), arm)
            folds = _folds(settings, series, name)
        except DataError as error:
            if tell is None or name in (data.learned, data.validation):
                raise
            tell(name, error)
            continue
        frames = Frames.of(series, fit.history, fit.slide_travel)
        sessions.append(Session(name, each.payload, frames, folds))
    rest = load_rest(folder, data, settings.recording, arm)
    if rest is None:
        return sessions, None
    still = of_the_arm(series_of(rest), arm)
    return sessions, Frames.of(still).at(still.seen.nonzero()[:, 0])


def _folds(settings: EvaluateSettings, series: Series, name: str) -> list[Split]:
    """What is learned from and what is scored in each fold; of a session for validation all is scored."""
    if settings.data.validation:
        every, none = torch.arange(len(series)), torch.arange(0)
        parts = Split(none, every) if name == settings.data.validation else Split(every, none)
        return [parts.within(series.seen)]
    folds = range(settings.split.folds) if settings.data.every_fold else [settings.split.fold]
    try:
        return [split(series.groups, settings.split, fold=fold).within(series.seen) for fold in folds]
    except DataError as error:
        raise DataError(f"{series.source}: {error}") from error
