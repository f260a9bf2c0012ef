"""What hangs at the tip: the payload that an identified arm's motors and shape tell, with an interval."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import torch

from apcc_torch.evaluation.arm_methods import follow, identified, under_load
from apcc_torch.evaluation.frames import Frames
from apcc_torch.evaluation.leaderboard import Session
from apcc_torch.evaluation.method import Known
from apcc_torch.identification.intervals import NORMAL_95
from apcc_torch.identification.tendon_arm import TIP_MASS

WINDOW = 20.0
"""Length of what an estimate sees, s: the end of a session."""
WINDOWS = 4
"""Windows of that length, evenly spread over the session before it, whose scatter its interval holds too."""
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


class Weighed(NamedTuple):
    """A payload by the arm's own scale of mass: kg, and its deviation by the fit's own account."""

    mass: float
    deviation: float


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
    values = identified(known, train.frames.at(train.folds[fold].training))
    parameters = under_load(known.parameters, values, ())

    def weighed(frames: Frames) -> Weighed:
        found = follow(parameters, frames, known, SEEN)
        mass = float(parameters.values(found.z)[TIP_MASS])
        at = parameters.names.index(f"{TIP_MASS}: payload")
        return Weighed(mass, float(parameters.blocks[TIP_MASS].spread) * math.sqrt(float(found.covariance[at, at])))

    loaded = {s.name: weighed(s.frames.at(s.folds[fold].training)).mass for s in sessions if s.payload}
    estimates = []
    for session in sessions:
        others = [s for s in sessions if s.payload and s.name != session.name]
        moments = sum(loaded[s.name] ** 2 for s in others)
        scale = sum(float(s.payload or 0.0) * loaded[s.name] for s in others) / moments if moments else 1.0
        end = weighed(session.frames.at(_window(session.frames, 1.0)))
        before = [weighed(session.frames.at(_window(session.frames, k / WINDOWS))).mass for k in range(1, WINDOWS)]
        scatter = float(torch.tensor([*before, end.mass], dtype=torch.float64).std())
        reach = NORMAL_95 * math.hypot(end.deviation, scatter)
        low, middle, high = (1e3 * scale * (end.mass + side * reach) for side in (-1.0, 0.0, 1.0))
        true = None if session.payload is None else 1e3 * session.payload
        told = ", ".join(s.name for s in others) if moments else "the arm's file"
        estimates.append(Estimate(session.name, middle, low, high, true, told))
    return estimates


def _window(frames: Frames, share: float) -> torch.Tensor:
    """Indices of the moments in the last seconds before a share of the recording."""
    end = float(frames.times[0]) + share * float(frames.times[-1] - frames.times[0])
    return ((frames.times > end - WINDOW) & (frames.times <= end)).nonzero()[:, 0]
