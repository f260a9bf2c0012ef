"""What hangs at the tip: the payload that an identified arm's motors and shape tell, with an interval."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import NamedTuple

import torch

from apcc_torch.evaluation.arm_methods import MASS_SPREAD, follow, identification, under_load
from apcc_torch.evaluation.frames import Frames
from apcc_torch.evaluation.leaderboard import Session
from apcc_torch.evaluation.method import Known
from apcc_torch.identification.fit import Fit, information
from apcc_torch.identification.left_out import NORMAL_95
from apcc_torch.identification.split import thinned
from apcc_torch.identification.tendon_arm import TIP_MASS, TendonArm

WINDOW = 20.0
"""Length of what an estimate sees, s: the end of a session."""
WINDOWS = 4
"""Windows of that length, evenly spread over what is scored, whose scatter and errors its interval holds too."""
SEEN = 100
"""Moments of a window that are fitted."""


class Estimate(NamedTuple):
    """A payload estimate, g.

    session: Whose last seconds it is of. grams, low_g, high_g: The estimate and its 95 % interval. true_g: Known
    payload, None if not. scale_from: What fixed the scale of mass: the arm's file, or known payloads.
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
    fixes the scale by its training part; a second estimate lets the session's own payload fix it too, by that part.

    Args:
        known: What is known of the arm.
        sessions: The recordings.
        learned: The one whose training part the arm is identified on.
        fold: Whose training part.
    """
    train = next(session for session in sessions if session.name == learned)
    scales = _Scales(known, identification(known, train.frames.at(train.folds[fold].training)))
    windows = {s.name: _windows(s.frames.at(s.folds[fold].validation)) for s in sessions}
    masses = {name: [scales.mass(window) for window in each] for name, each in windows.items()}
    loaded = {s.name: scales.mass(s.frames.at(s.folds[fold].training)) for s in sessions if s.payload}
    found = []
    for session in sessions:
        others = [s for s in sessions if s.payload is not None and s.name != session.name]
        found.append(_estimate(scales, session, others, others, windows[session.name][-1], masses, loaded))
        if session.payload:
            by = [*others, session]
            found.append(_estimate(scales, session, others, by, windows[session.name][-1], masses, loaded))
    return found


def _estimate(
    scales: _Scales,
    session: Session,
    others: Sequence[Session],
    scaled_by: Sequence[Session],
    end: Frames,
    masses: Mapping[str, Sequence[float]],
    loaded: Mapping[str, float],
) -> Estimate:
    """Of the end of a session, from the masses of the windows of all, kg by the arm's own scale."""
    known = {s.name: s.payload for s in scaled_by if s.payload}
    moments = sum(loaded[name] ** 2 for name in known)
    scale = sum(payload * loaded[name] for name, payload in known.items()) / moments if moments else 1.0
    own = torch.tensor(masses[session.name], dtype=torch.float64)
    # Of the others the payload is known, and so how far such an estimate is off.
    off = [scale * mass - float(s.payload or 0.0) for s in others for mass in masses[s.name]]
    told = math.hypot(scale * scales.deviation(end, fixed=bool(known)), scale * float(own.std()))
    reach = NORMAL_95 * math.hypot(told, math.sqrt(sum(e * e for e in off) / max(len(off), 1)))
    low, middle, high = (1e3 * (scale * float(own[-1]) + side * reach) for side in (-1.0, 0.0, 1.0))
    true = None if session.payload is None else 1e3 * session.payload
    names = (f"{name}, its training part" if name == session.name else name for name in known)
    by = ", ".join(names) or "the arm's file"
    return Estimate(session.name, middle, low, high, true, by)


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


def _windows(frames: Frames) -> list[Frames]:
    """The last seconds before each of evenly spread moments, the last one the end."""
    begin, length = float(frames.times[0]), float(frames.times[-1] - frames.times[0])
    ends = [begin + length * k / WINDOWS for k in range(1, WINDOWS + 1)]
    return [frames.at(((frames.times > end - WINDOW) & (frames.times <= end)).nonzero()[:, 0]) for end in ends]
