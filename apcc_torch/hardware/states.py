"""The states of a run and the only ways between them."""

from __future__ import annotations

from enum import Enum

from apcc_torch.errors import SafetyError


class State(Enum):
    """Where a run stands. Only ARMED, RUNNING and HOLD have torque; commands are sent in RUNNING alone."""

    DISARMED = "disarmed"
    ARMED = "armed"
    RUNNING = "running"
    HOLD = "hold"
    FAULT = "fault"


ALLOWED = {
    State.DISARMED: {State.ARMED, State.FAULT},
    State.ARMED: {State.RUNNING, State.HOLD, State.DISARMED, State.FAULT},
    State.RUNNING: {State.HOLD, State.DISARMED, State.FAULT},
    State.HOLD: {State.DISARMED, State.FAULT},
    State.FAULT: set[State](),
}
"""Next states. A run that failed is over: FAULT leads nowhere."""


class StateMachine:
    """The present state; refuses every step that `ALLOWED` does not have."""

    def __init__(self) -> None:
        self.state = State.DISARMED

    def to(self, state: State) -> None:
        """Takes one step.

        Raises:
            SafetyError: There is no such step.
        """
        if state not in ALLOWED[self.state]:
            raise SafetyError(f"a run that is {self.state.value} cannot become {state.value}")
        self.state = state
