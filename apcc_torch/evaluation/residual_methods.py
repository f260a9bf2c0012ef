"""Physics with a learned rest: what the identified arm leaves unexplained, by a regression."""

from __future__ import annotations

from dataclasses import replace

import torch
from torch import Tensor

from apcc_torch.evaluation.arm_methods import IdentifiedUnderLoad, moved_on, positions_at_rest
from apcc_torch.evaluation.frames import Frames
from apcc_torch.evaluation.learning import MOST, KernelMethod
from apcc_torch.evaluation.method import BOTH
from apcc_torch.evaluation.tasks import Task
from apcc_torch.identification.split import thinned


class LearnedRest(IdentifiedUnderLoad):
    """The identified arm, its load followed where the task lets it, and kernel ridge regression on what that leaves.

    The regression sees the motors of the last moments and where the arm has the bodies, one step ahead the two samples
    before too. Where a load is followed, it learns from what is seen of the session, as every regression does.
    """

    family = BOTH

    def answers(self, task: Task) -> bool:
        """See `Method.answers`."""
        return task.motors and not task.shown

    def fit(self, train: Frames) -> None:
        """See `Method.fit`."""
        super().fit(train)
        self.train = train

    def predict(self, test: Frames, task: Task, seen: Frames | None = None) -> Tensor:
        """See `Method.predict`."""
        learned = self.train if seen is None else seen
        values = self.values if seen is None else self.loaded_values(seen)
        some = learned.at(thinned(learned.past.seen if task.ahead else torch.arange(len(learned)), MOST))
        modelled = moved_on if task.ahead else positions_at_rest
        there, here = (modelled(self.arm, frames, values) for frames in (some, test))
        told = Task(tuple(range(there.shape[1])), True, ahead=task.ahead)
        regression = KernelMethod(self.known)
        model = regression.learned(replace(some, positions=there), some.positions - there, told)
        return here + regression.said(model, replace(test, positions=here), told)
