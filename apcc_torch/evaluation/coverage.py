"""How honest the identified arm is: how much of what was held back its 95 % prediction intervals hold."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import torch

from apcc_torch.evaluation.arm_methods import identification
from apcc_torch.evaluation.leaderboard import Session
from apcc_torch.evaluation.method import Known
from apcc_torch.identification.intervals import coverage, half_widths
from apcc_torch.identification.tendon_arm import TendonArm


class Covered(NamedTuple):
    """Of one body, from the motors alone.

    session, body: Of the recording, the body from 1. folds: Percent of the coordinates that lay within their
    intervals, a value a fold. half_width: Of the intervals, mm, the mean.
    """

    session: str
    body: int
    folds: tuple[float, ...]
    half_width: float

    @property
    def mean(self) -> float:
        """Percent, over the folds."""
        return sum(self.folds) / len(self.folds)


def covered(known: Sequence[Known], sessions: Sequence[Session], learned: str, every: int) -> list[Covered]:
    """Every body's, in the sessions whose payload is the one that the arm was identified with.

    Args:
        known: What is known of the arm, one a fold.
        sessions: The recordings.
        learned: The one whose training part the arm is identified on.
        every: Of the moments to be scored each so many-th is.
    """
    train = next(session for session in sessions if session.name == learned)
    found: dict[tuple[str, int], list[tuple[float, float]]] = {}
    for k, each in enumerate(known):
        told, arm = identification(each, train.frames.at(train.folds[k].training)), TendonArm(each.arm)
        values = each.parameters.values(told.z)
        for session in sessions:
            held = session.folds[k].validation[::every]
            if session.payload != train.payload or not len(held):
                continue
            test = session.frames.at(held)
            with torch.no_grad():
                within = half_widths(arm, each.parameters, test.drive, told)
                shares = coverage(arm.predict(test.drive, values), within, test.positions)
            for body, share in enumerate(shares.tolist()):
                width = 1e3 * float(within[:, body].nanmean())
                found.setdefault((session.name, body + 1), []).append((100.0 * share, width))
    return [
        Covered(name, body, tuple(share for share, _ in folds), sum(width for _, width in folds) / len(folds))
        for (name, body), folds in found.items()
    ]
