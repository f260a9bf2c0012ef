"""Rows whose controllers look ahead: after each step, for the next one."""

from __future__ import annotations

from torch import Tensor

from apcc_torch.control.ahead import Ahead
from apcc_torch.envs.adaptation import AdaptiveLoop
from apcc_torch.envs.row_trees import select
from apcc_torch.envs.simulator import EnvState, Simulator


class RowsAhead:
    """Looks ahead from a step that was made, in what a real arm would have left of the period.

    Rows that are done do not look: what they remember stays. One that begins again has no plan for its first step.

    Args:
        simulator: Whose rows they are.
        loop: Its controller, which looks ahead.
        rows: How many there are.
        mode: How the rollouts are run, see `native.compiled`.
    """

    def __init__(self, simulator: Simulator, loop: AdaptiveLoop, rows: int, mode: str) -> None:
        self.simulator, self.loop = simulator, loop
        self.run = loop.rollouts(mode, rows)

    @classmethod
    def of(cls, simulator: Simulator, rows: int, mode: str) -> RowsAhead | None:
        """That of a simulator; None where its controller does not look ahead, or it has none."""
        loop = simulator.loop
        return None if loop is None or not loop.looks else cls(simulator, loop, rows, mode)

    def __call__(self, state: EnvState, done: Tensor) -> Ahead:
        """What the controllers remember of it then.

        Args:
            state: After the step.
            done: (N,) bool, rows that the step ended.
        """
        assert state.controller is not None  # it looks ahead
        began = self.simulator.period * (state.step - 1).to(state.controller.q_bar.dtype)
        target = self.simulator.task.target(state.goal, began)
        later = self.loop.look_ahead(state.controller, target, state.rows.lengths, self.run)
        assert later.ahead is not None  # as before
        return select(done, plans(state), later.ahead)


def plans(state: EnvState) -> Ahead:
    """What the controllers of rows remember that look ahead."""
    assert state.controller is not None and state.controller.ahead is not None  # they look ahead
    return state.controller.ahead


def with_plans(state: EnvState, ahead: Ahead) -> EnvState:
    """The state with this in place of it."""
    assert state.controller is not None  # as above
    return state._replace(controller=state.controller._replace(ahead=ahead))
