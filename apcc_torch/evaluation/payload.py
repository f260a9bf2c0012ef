"""What hangs at the tip: the payload that an identified arm's motors and shape tell, with an interval."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import torch

from apcc_torch.evaluation.arm_methods import MASS_SPREAD, follow, identification, under_load
from apcc_torch.evaluation.frames import Frames
from apcc_torch.evaluation.leaderboard import Session
from apcc_torch.evaluation.method import Known
from apcc_torch.identification.fit import Fit, information
from apcc_torch.identification.intervals import NORMAL_95
from apcc_torch.identification.split import thinned
from apcc_torch.identification.tendon_arm import TIP_MASS, TendonArm

WINDOW = 20.0
"""Length of what an estimate sees, s: the end of a session."""
WINDOWS = 4
"""Windows of that length, evenly spread over the session, whose scatter its interval holds too."""
SEEN = 100
"""Moments of a window that are fitted."""


class Estimate(NamedTuple):
    """A payload estimate, g.

    session: Whose last seconds it is of. grams, low_g, high_g: The estimate and its 95 % interval. true_g: Known
    payload, None if not. scale_from: What fixed the scale of mass: the arm's file, or a session of known payload.
    """

    session: str
    grams: float
    low_g: float
    high_g: float
    true_g: float | None
    scale_from: str


def payloads(known: Known, sessions: Sequence[Session], learned: str, fold: int) -> list[Estimate]:
    """Estimates at the end of every session, by an arm identified on the training part of `learned`.

    The arm knows masses by their ratio to its stiffness, as its file says. A session of another payload that is known
    fixes the scale by its training part.

    Args:
        known: What is known of the arm.
        sessions: The recordings.
        learned: The one whose training part the arm is identified on.
        fold: Whose training part.
    """
    train = next(session for session in sessions if session.name == learned)
    found = identification(known, train.frames.at(train.folds[fold].training))
    scales = _Scales(known, found)
    loaded = {s.name: scales.mass(s.frames.at(s.folds[fold].training)) for s in sessions if s.payload}
    estimates = []
    for session in sessions:
        others = [s for s in sessions if s.payload and s.name != session.name]
        moments = sum(loaded[s.name] ** 2 for s in others)
        scale = sum(float(s.payload or 0.0) * loaded[s.name] for s in others) / moments if moments else 1.0
        windows = [session.frames.at(_window(session.frames, k / WINDOWS)) for k in range(1, WINDOWS + 1)]
        masses = [scales.mass(window) for window in windows]
        scatter = float(torch.tensor(masses, dtype=torch.float64).std())
        reach = NORMAL_95 * math.hypot(scales.deviation(windows[-1], fixed=bool(moments)), scatter)
        low, middle, high = (1e3 * scale * (masses[-1] + side * reach) for side in (-1.0, 0.0, 1.0))
        true = None if session.payload is None else 1e3 * session.payload
        told = ", ".join(s.name for s in others) if moments else "the arm's file"
        estimates.append(Estimate(session.name, middle, low, high, true, told))
    return estimates


class _Scales:
    """Weighs with an identified arm: all its parameters held, the payload fitted."""

    def __init__(self, known: Known, found: Fit) -> None:
        self.known, self.found = known, found
        self.values = known.parameters.values(found.z)
        self.parameters = under_load(known.parameters, self.values, ())

    def mass(self, frames: Frames) -> float:
        """By the arm's own scale of mass, kg."""
        return float(self.parameters.values(self._fit(frames).z)[TIP_MASS])

    def _fit(self, frames: Frames) -> Fit:
        return follow(self.parameters, frames, self.known, SEEN)

    def deviation(self, frames: Frames, fixed: bool) -> float:
        """Of the mass, kg: of what the moments leave open and, unless another load fixed the scale, of the arm."""
        weighed = self._fit(frames)
        if fixed:
            return MASS_SPREAD * float(weighed.covariance[0, 0]) ** 0.5
        every = under_load(self.known.parameters, self.values, tuple(self.known.parameters.blocks))
        z = torch.cat((torch.zeros_like(self.found.z), weighed.z))
        some = frames.at(thinned(torch.arange(len(frames)), SEEN))
        size = weighed.noise * math.sqrt(weighed.correlation)
        said = information(TendonArm(self.known.arm), every, some.drive, some.positions, z, size)
        own = said[-1, -1] + 1.0
        pull = said[-1, :-1] / own  # how the mass follows the parameters that are held
        return MASS_SPREAD * float(1.0 / own + pull @ self.found.covariance @ pull) ** 0.5


def _window(frames: Frames, share: float) -> torch.Tensor:
    """Indices of the moments in the last seconds before a share of the recording."""
    end = float(frames.times[0]) + share * float(frames.times[-1] - frames.times[0])
    return ((frames.times > end - WINDOW) & (frames.times <= end)).nonzero()[:, 0]
