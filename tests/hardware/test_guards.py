"""Dwell times, budgets, and the table of stops."""

from __future__ import annotations

from itertools import pairwise

import pytest
from hypothesis import given
from hypothesis import strategies as st

from apcc_torch.errors import ConfigError, SafetyError, ValueRangeError
from apcc_torch.hardware.guards import Dwell, Guards, GuardSettings
from apcc_torch.hardware.states import ALLOWED, State, StateMachine
from apcc_torch.hardware.stops import Ending, StopReason, exit_code_table
from fake_runs import LIMITS


@given(st.lists(st.booleans(), min_size=1, max_size=40), st.integers(0, 10))
def test_a_dwell_is_over_after_an_unbroken_row(conditions: list[bool], turns: int) -> None:
    dwell = Dwell(turns)
    for k, condition in enumerate(conditions):
        row = conditions[max(k - turns, 0) : k + 1]
        assert dwell.over(condition, float(k)) == (len(row) > turns and all(row))


@given(st.lists(st.floats(0.0, 0.5), max_size=30), st.integers(0, 5))
def test_the_overrun_budget_counts_within_its_window(gaps: list[float], budget: int) -> None:
    guards = Guards(GuardSettings(overruns=budget, overrun_window=1.0), LIMITS)
    times: list[float] = []
    for gap in gaps:
        times.append((times[-1] if times else 0.0) + gap)
        recent = [t for t in times if times[-1] - t <= 1.0]
        assert (guards.on_overrun(1, times[-1]) is not None) == (len(recent) > budget)


def test_readings_and_commands_fail_apart() -> None:
    guards = Guards(GuardSettings(failed_exchanges=3), LIMITS)
    error = OSError("gone")
    assert guards.on_failed_send(error) is None and guards.on_failed_read(error) is None
    assert guards.on_failed_send(error) is None and guards.failed == 2
    guards.on_sent()
    assert guards.failed == 1
    assert guards.on_failed_read(error) is None
    stop = guards.on_failed_read(error)
    assert stop is not None and stop.reason is StopReason.COMMUNICATION and "3 readings" in stop.message


@pytest.mark.parametrize(
    "change",
    [
        {"arrival_error": 0.0},
        {"arrival_error": -1.0},
        {"effort_dwell": -0.1},
        {"failed_exchanges": 0},
        {"max_error": 0.0},
    ],
)
def test_limits_must_mean_something(change: dict[str, float]) -> None:
    with pytest.raises(ValueRangeError, match=f"^{next(iter(change))} must"):
        GuardSettings(**change)  # type: ignore[arg-type]


def test_codes_are_those_of_the_manual() -> None:
    codes = [reason.code for reason in StopReason]
    assert codes == sorted(codes) and 2 not in codes
    faults = [reason.code for reason in StopReason if reason.failed]
    assert len(set(faults)) == len(faults), "every fault has its own"
    table = exit_code_table()
    assert all(reason.value in table and reason.meaning in table for reason in StopReason)
    # As a shell has it: 128 + the signal's number.
    assert (StopReason.INTERRUPTED.code, StopReason.TERMINATED.code) == (128 + 2, 128 + 15)


def test_endings_are_the_tables_and_the_changes() -> None:
    guards = GuardSettings(endings={"over_effort": "torque_off"})
    assert guards.ending(StopReason.OVER_EFFORT) is Ending.TORQUE_OFF
    assert all(guards.ending(r) is r.ending for r in StopReason if r is not StopReason.OVER_EFFORT)
    with pytest.raises(ConfigError, match=r"^endings must be one of .*over_efort"):
        GuardSettings(endings={"over_efort": "hold"})
    with pytest.raises(ConfigError, match=r"^endings\.slack must be one of hold, torque_off, got 'drop'"):
        GuardSettings(endings={"slack": "drop"})


def test_states_only_go_forward_and_faults_stay() -> None:
    assert not ALLOWED[State.FAULT]
    machine = StateMachine()
    for _, state in pairwise([State.DISARMED, State.ARMED, State.RUNNING, State.HOLD, State.DISARMED]):
        machine.to(state)
    with pytest.raises(SafetyError, match="disarmed cannot become running"):
        machine.to(State.RUNNING)
