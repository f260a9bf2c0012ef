"""Every method on every task: how far its bodies are from the measured ones."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import torch
from torch import Tensor

from apcc_torch.errors import ApccError, in_a_line
from apcc_torch.evaluation.frames import Frames
from apcc_torch.evaluation.method import Known, Method
from apcc_torch.evaluation.tasks import Task
from apcc_torch.identification.split import Split


class Score(NamedTuple):
    """Of one method on one task: root of the mean squared distance of a body, mm.

    session, body: Of the recording, the body from 1. folds: One value a fold. seconds: Of a processor that the method
    took in all.
    """

    task: str
    method: str
    family: str
    session: str
    body: int
    folds: tuple[float, ...]
    seconds: float

    @property
    def mean(self) -> float:
        """Over the folds."""
        return sum(self.folds) / len(self.folds)


class Failure(NamedTuple):
    """A method that could not take part, and why."""

    method: str
    why: str


@dataclass(frozen=True)
class Session:
    """One recording: all its moments, and in each fold those to learn from and those to be scored."""

    name: str
    payload: float | None
    frames: Frames
    folds: Sequence[Split]


def evaluate(
    known: Sequence[Known],
    sessions: Sequence[Session],
    learned: str,
    tasks: Sequence[Task],
    methods: Mapping[str, Callable[[Known], Method]],
    every: int,
    watch: Callable[[Sequence[str]], Iterable[str]],
) -> tuple[list[Score], list[Failure]]:
    """Lets every method learn and predict, in every fold.

    Args:
        known: What methods may know, one a fold, so that nothing is carried over.
        sessions: The recordings.
        learned: The one whose training part methods learn from.
        tasks: What is asked.
        methods: Name -> what makes it of what is known.
        every: Of the moments to be scored each so many-th is.
        watch: Wraps the methods' names as they take their turns, for a progress bar.
    """
    train = next(session for session in sessions if session.name == learned)
    folds = range(len(train.folds))
    scores: list[Score] = []
    failures: list[Failure] = []
    for name in watch(list(methods)):
        found: dict[tuple[Task, str, int], list[float]] = {}
        begun = time.process_time()
        method = methods[name](known[0])
        if not any(map(method.answers, tasks)):
            continue
        try:
            for fold in folds:
                method = methods[name](known[fold])
                method.fit(train.frames.at(train.folds[fold].training))
                for task in filter(method.answers, tasks):
                    for session in (each for each in sessions if len(each.folds[fold].validation)):
                        for body, error in _errors(method, task, session, fold, every).items():
                            found.setdefault((task, session.name, body), []).append(error)
        except (ApccError, ArithmeticError, ValueError, torch.linalg.LinAlgError) as error:  # type: ignore[attr-defined]
            # What a method cannot do with these numbers is its own failure: the others go on.
            failures.append(Failure(name, in_a_line(error)))
            continue
        taken = time.process_time() - begun
        scores += [
            Score(task.name, name, method.family, session_name, body, tuple(errors), taken)
            for (task, session_name, body), errors in found.items()
        ]
    return scores, failures


def _errors(method: Method, task: Task, session: Session, fold: int, every: int) -> dict[int, float]:
    """Body from 1 -> root of the mean squared distance, mm, of the bodies that are not shown."""
    parts = session.folds[fold]
    truth = session.frames.at(parts.validation[::every])
    if task.ahead:
        truth = truth.at(truth.past.seen)
    seen = truth if method.hindsight else session.frames.at(parts.training) if task.online else None
    with torch.no_grad():
        found = method.predict(truth.showing(task), task, seen)
    return {body + 1: rms_mm(found[:, body], truth.positions[:, body]) for body in task.hidden(found.shape[1])}


def rms_mm(predicted: Tensor, measured: Tensor) -> float:
    """Root of the mean squared distance between points (N, 3), mm."""
    return 1e3 * float((predicted - measured).square().sum(-1).mean().sqrt())
