"""When a controller of the loop looks ahead: in what a turn leaves of its period, and only where that is enough."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable

import torch

from apcc_torch.control.ahead import Ahead
from apcc_torch.control.lookahead_controller import LookaheadController
from apcc_torch.control.step_io import ControllerState, Target
from apcc_torch.native.compiled import Step

LAST = 16
"""Looks whose times are kept. A look that is left out forgets the oldest: a hold-up does not end them for good."""
RESERVE = 1.2
"""Times that long have to be left before a deadline, for a look to begin."""


class LookingAhead:
    """Looks ahead from a state as far as there is time.

    A look that was begun is ended, so none is begun that may end late: one is expected to take as long as the longest
    of the last ones.

    Args:
        controller: Which looks.
        run: Its `rollouts`; None for itself, eagerly.
    """

    def __init__(self, controller: LookaheadController, run: Step | None = None) -> None:
        self.controller = controller
        self.run = run
        self.took: deque[float] = deque(maxlen=LAST)  # s

    def __call__(
        self, state: ControllerState, target: Target, now: Callable[[], float], deadline: float
    ) -> Ahead | None:
        """What the controller remembers after a look; None where a deadline is too near for one.

        Args:
            state: After a step.
            target: Of that step.
            now: The clock, s.
            deadline: When the loop has to be served again, s.
        """
        began = now()
        if began + RESERVE * max(self.took, default=0.0) >= deadline:
            if self.took:
                self.took.popleft()
            return None
        with torch.inference_mode():
            later = self.controller.look_ahead(state, target, self.run).ahead
        self.took.append(now() - began)
        return later
