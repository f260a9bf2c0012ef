"""The runner on devices in memory: how every fault ends, and that none sends a command outside the limits."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from apcc_torch.errors import ConfigError, SafetyError
from apcc_torch.hardware.limits import CommandLimits
from apcc_torch.hardware.log import RunLog
from apcc_torch.hardware.log_format import layouts
from apcc_torch.hardware.log_reader import read_log
from apcc_torch.hardware.loop import Loop
from apcc_torch.hardware.setup import LoopSettings
from apcc_torch.hardware.states import State
from apcc_torch.hardware.stops import Ending, StopReason
from fake_devices import Fault
from fake_runs import DURATION, GUARDS, LIMITS, SENSING, FakeRun, fake_run, sensing

R = StopReason


def check_commands(run: FakeRun, limits: CommandLimits = LIMITS) -> None:
    """Every command was finite, in range, reachable from the one before, and sent under torque.

    The first is reached from where the arm was as torque went on.
    """
    last, at = run.actuator.armed
    for time, y, torque in run.actuator.commands:
        assert torque, "sent without torque, or in a hold"
        assert np.isfinite(y).all()
        assert (y >= limits.lower).all() and (y <= limits.upper).all()
        assert (np.abs(y - last) <= np.minimum(limits.rate * (time - at), limits.step) + 1e-12).all()
        last, at = y, time


def check_end(run: FakeRun) -> None:
    """The motors are safe, and the record says why, once and in order."""
    assert not run.actuator.torque and not run.actuator.connected and not run.sensor.connected
    assert run.outcome.state in (State.DISARMED, State.FAULT)
    events = run.witness.events
    assert events[-1].kind == "end" and events[-1].reason is run.outcome.reason
    assert [event.kind for event in events].count("stop") == 1
    assert len([tick for tick in run.witness.ticks if tick.state is State.RUNNING]) >= run.outcome.ticks


def test_an_undisturbed_run_ends_after_its_duration_held() -> None:
    run = fake_run()
    assert run.outcome.reason is R.DURATION and run.outcome.exit_code == 0
    assert run.outcome.ending is Ending.HOLD and run.outcome.state is State.DISARMED
    assert run.outcome.overruns == 0
    states = [event.state for event in run.witness.events if event.kind == "state"]
    assert states == [State.ARMED, State.RUNNING, State.HOLD, State.DISARMED]
    # The wish was far: it was approached at the rate limit and reached.
    sent = np.array([y for _, y, _ in run.actuator.commands])
    assert np.allclose(sent[0], -0.0021 - 0.002) and np.allclose(sent[-1], -0.01)
    assert run.actuator.held
    check_commands(run)
    check_end(run)
    # On the grid: nothing is late where computing takes no time.
    running = [tick for tick in run.witness.ticks if tick.state is State.RUNNING]
    assert [tick.index for tick in running] == list(range(len(running)))
    assert all(tick.lateness == pytest.approx(0.0, abs=1e-12) for tick in running)
    assert run.outcome.duration == pytest.approx(DURATION)


AT = 0.6

ENDS = {
    "no_device": (R.NOT_CONNECTED, None, State.FAULT),
    "no_sensor": (R.NOT_CONNECTED, None, State.FAULT),
    "arm_fails": (R.NOT_ARMED, Ending.TORQUE_OFF, State.FAULT),
    "arm_moves": (R.NOT_ARMED, Ending.TORQUE_OFF, State.FAULT),
    "read_fails": (R.COMMUNICATION, Ending.TORQUE_OFF, State.FAULT),
    "send_fails": (R.COMMUNICATION, Ending.TORQUE_OFF, State.FAULT),
    "send_unsure": (R.COMMUNICATION, Ending.TORQUE_OFF, State.FAULT),
    "motor_fault": (R.DEVICE_FAULT, Ending.TORQUE_OFF, State.FAULT),
    "effort": (R.OVER_EFFORT, Ending.HOLD, State.DISARMED),
    "effort_peak": (R.EFFORT_CAP, Ending.TORQUE_OFF, State.FAULT),
    "slack": (R.SLACK, Ending.HOLD, State.DISARMED),
    "slipped": (R.TENDON_RANGE, Ending.HOLD, State.DISARMED),
    "reading_nan": (R.TENDON_RANGE, Ending.HOLD, State.DISARMED),
    "effort_nan": (R.EFFORT_CAP, Ending.TORQUE_OFF, State.FAULT),
    "stream_ended": (R.SENSOR_LOST, Ending.HOLD, State.DISARMED),
    "untracked": (R.SENSOR_STALE, Ending.HOLD, State.DISARMED),
    "frozen": (R.SENSOR_STALE, Ending.HOLD, State.DISARMED),
    "repeating": (R.SENSOR_STALE, Ending.HOLD, State.DISARMED),
    "late": (R.SENSOR_STALE, Ending.HOLD, State.DISARMED),
    "nan": (R.SENSOR_STALE, Ending.HOLD, State.DISARMED),
    "not_a_rotation": (R.SENSOR_STALE, Ending.HOLD, State.DISARMED),
    "one_untracked": (R.SENSOR_DROPOUT, Ending.HOLD, State.DISARMED),
    "swapped": (R.SENSOR_DROPOUT, Ending.HOLD, State.DISARMED),
    "command_nan": (R.COMMAND_NOT_FINITE, Ending.HOLD, State.DISARMED),
    "refuses": (R.CONTROLLER_ERROR, Ending.HOLD, State.DISARMED),
    "diverged": (R.DIVERGENCE, Ending.HOLD, State.DISARMED),
    "bug": (R.INTERNAL_ERROR, Ending.TORQUE_OFF, State.FAULT),
    "slow": (R.OVERRUN, Ending.HOLD, State.DISARMED),
    "disk_full": (R.LOG_FAILED, Ending.HOLD, State.DISARMED),
    "ctrl_c": (R.INTERRUPTED, Ending.HOLD, State.DISARMED),
    "sigterm": (R.TERMINATED, Ending.HOLD, State.DISARMED),
    "arrived": (R.ARRIVED, Ending.HOLD, State.DISARMED),
}


@pytest.mark.parametrize("kind", ENDS)
def test_every_fault_ends_as_the_table_says(kind: str) -> None:
    reason, ending, state = ENDS[kind]
    early = reason in (R.NOT_CONNECTED, R.NOT_ARMED)
    run = fake_run([Fault(kind, 0.0 if early else AT)], replace(GUARDS, overruns=5))
    outcome = run.outcome
    assert (outcome.reason, outcome.ending, outcome.state) == (reason, ending, state), outcome.message
    assert outcome.exit_code == reason.code
    if early:
        assert not run.actuator.commands
    else:
        assert outcome.ticks > 10
        ended = run.witness.zero + outcome.duration
        assert AT <= ended < AT + 0.7, "a fault ends the run soon, and not before it is there"
    check_commands(run)
    check_end(run)


def test_a_jump_is_not_followed_and_ends_the_run() -> None:
    run = fake_run([Fault("jump", AT)])
    assert run.outcome.reason in (R.SENSOR_STALE, R.SENSOR_DROPOUT)
    jumped = [t for t in run.witness.ticks if t.frame is not None and t.now > AT]
    assert jumped and not any(tick.frame.usable for tick in jumped if tick.frame is not None)
    poses = np.array([tick.frame.T for tick in jumped if tick.frame is not None])
    assert np.abs(poses[:, :, :3, 3] - run.sensor.rest[:, :3, 3]).max() < 1e-3, "the controller keeps the last pose"


def test_no_pose_that_reaches_the_controller_is_ever_not_finite() -> None:
    run = fake_run([Fault("nan", 0.5, 0.6), Fault("one_untracked", 0.7, 0.9)])
    assert run.outcome.reason is R.DURATION
    assert all(np.isfinite(tick.frame.T).all() for tick in run.witness.ticks if tick.frame is not None)
    # Turns without a whole frame step nothing, and send the last wish.
    blind = [t for t in run.witness.ticks if 0.51 < t.now < 0.6 or 0.71 < t.now < 0.9]
    assert blind and all(tick.decision is None and tick.fresh for tick in blind)


def test_frames_that_lack_a_body_can_be_stepped_on() -> None:
    run = fake_run([Fault("one_untracked", 0.7, 0.9)], sensing=sensing(partial="mask"))
    partial = [t for t in run.witness.ticks if 0.71 < t.now < 0.9]
    assert run.outcome.reason is R.DURATION and all(tick.decision is not None for tick in partial)
    assert all(t.frame is not None and t.frame.position_ok.tolist() == [True, False, True] for t in partial)


def test_the_controller_sees_the_tendons_as_they_were_last_measured() -> None:
    run = fake_run([Fault("read_fails", 0.5, 0.539)])
    last, wanted = None, []
    for tick in run.witness.ticks:
        last = last if tick.reading is None else tick.reading.y
        if tick.decision is not None:
            wanted.append(last)
    assert any(tick.reading is None for tick in run.witness.ticks)
    assert len(wanted) > 50 and np.ptp(wanted) > 1e-3, "they moved"
    np.testing.assert_array_equal(run.step.tendons[-len(wanted) :], wanted)


def test_few_failed_exchanges_are_survived() -> None:
    run = fake_run([Fault("read_fails", 0.5, 0.539), Fault("send_fails", 0.7, 0.739)])
    assert run.outcome.reason is R.DURATION
    kinds = [event.kind for event in run.witness.events]
    assert kinds.count("exchange_failed") == 8
    check_commands(run)


def test_a_command_that_failed_may_have_come_through() -> None:
    """The wish turns round while commands fail: the next is within reach of all that the motors may have been told."""
    run = fake_run([Fault("turned_round", 0.695, 0.715), Fault("send_unsure", 0.695, 0.725)])
    assert [event.kind for event in run.witness.events].count("exchange_failed") == 3
    assert run.outcome.reason is R.DURATION
    check_commands(run)


@pytest.mark.parametrize("kind", ["read_fails", "motor_fault", "effort_peak"])
def test_a_hold_that_fails_lets_go(kind: str) -> None:
    run = fake_run([Fault("arrived", 0.5), Fault(kind, 1.04)], duration=5.0)
    reason = {"read_fails": R.COMMUNICATION, "motor_fault": R.DEVICE_FAULT, "effort_peak": R.EFFORT_CAP}[kind]
    assert run.witness.events[-1].time > 1.0
    held = [event for event in run.witness.events if event.state is State.HOLD]
    assert held, "the arm had arrived and was held"
    assert run.outcome.reason is reason and run.outcome.state is State.FAULT
    assert run.outcome.ending is Ending.TORQUE_OFF
    check_end(run)


def test_a_hold_that_cannot_begin_lets_go() -> None:
    run = fake_run([Fault("ctrl_c", 0.5), Fault("hold_fails", 0.0)])
    assert run.outcome.reason is R.COMMUNICATION and run.outcome.ending is Ending.TORQUE_OFF
    check_end(run)


def test_torque_off_that_fails_is_a_fault_and_is_said() -> None:
    run = fake_run([Fault("torque_off_fails", 0.0)])
    assert run.outcome.state is State.FAULT
    assert any("watchdog" in event.message for event in run.witness.events)


STAGES = ("turn", "_read", "_sense", "_decide", "_send", "_next")


def stopped(monkeypatch: pytest.MonkeyPatch, stage: str, seconds: float) -> None:
    """The process stands still for a while, once, just before a stage of the loop."""
    original, over = getattr(Loop, stage), []

    def late(loop: Loop, *given: Any) -> Any:
        if not over and loop.setup.clock.now() >= AT:
            over.append(stage)
            loop.setup.clock.wait_until(loop.setup.clock.now() + seconds)
        return original(loop, *given)

    monkeypatch.setattr(Loop, stage, late)


@pytest.mark.parametrize("stage", STAGES)
def test_a_stopped_process_ends_the_run_and_every_period_it_missed_counts(
    stage: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    stopped(monkeypatch, stage, 2.005)
    run = fake_run(loop=LoopSettings(rate=50.0, warm_up=2, hold=0.1), duration=5.0)
    assert run.outcome.reason is R.PAUSED and "stood still for 2.0" in run.outcome.message
    assert (run.outcome.ending, run.outcome.state) == (Ending.HOLD, State.DISARMED)
    assert run.outcome.overruns == 100
    check_commands(run)
    check_end(run)


@pytest.mark.parametrize("stage", STAGES)
def test_after_a_pause_that_is_allowed_no_old_frame_is_used(stage: str, monkeypatch: pytest.MonkeyPatch) -> None:
    stopped(monkeypatch, stage, 1.005)
    run = fake_run(
        [Fault("turned_round", AT + 0.5)],  # what a frame after the pause asks for
        replace(GUARDS, max_pause=None, overruns=1000),
        sensing=sensing(stale=5.0, dropout=5.0),
        loop=LoopSettings(rate=50.0, warm_up=2, hold=0.1),
        duration=3.0,
    )
    assert run.outcome.reason is R.DURATION and run.outcome.overruns == 50
    running = [tick for tick in run.witness.ticks if tick.state is State.RUNNING]
    for tick in running:
        if tick.decision is not None:
            assert tick.frame is not None and tick.frame.usable and tick.frame.age <= SENSING.max_age
    assert any(tick.decision is not None for tick in running[-10:]), "it went on"
    check_commands(run)


def test_a_command_from_a_frame_that_grew_old_in_the_step_is_not_sent() -> None:
    """The process is stopped within the controller's step: the next frame's wish is the first that counts."""
    faults = [Fault("stopped", AT, AT + 0.005), Fault("turned_round", AT)]
    run = fake_run(faults, replace(GUARDS, overruns=1000), sensing=sensing(stale=5.0, dropout=5.0))
    late = next(tick for tick in run.witness.ticks if tick.control > 0.1)
    assert late.decision is not None and (late.decision.y > 0).all() and (late.requested < 0).all()
    after = next(tick for tick in run.witness.ticks if tick.index > late.index)
    assert (after.requested > 0).all() and run.outcome.reason is R.DURATION
    check_commands(run)


def test_endings_can_be_chosen() -> None:
    chosen = replace(GUARDS, endings={"effort_cap": "hold", "duration": "torque_off"})
    assert fake_run([Fault("effort_peak", AT)], chosen).outcome.ending is Ending.HOLD
    plain = fake_run(guards=chosen).outcome
    assert (plain.ending, plain.state, plain.exit_code) == (Ending.TORQUE_OFF, State.DISARMED, 0)


def test_a_second_request_ends_the_hold() -> None:
    long = fake_run([Fault("ctrl_c", AT, AT + 0.005)], loop=replace(fake_run().setup.loop, hold=3.0))
    held = [tick for tick in long.witness.ticks if tick.state is State.HOLD]
    assert len(held) == pytest.approx(300, abs=2)


def test_torque_needs_every_condition() -> None:
    def refuse() -> None:
        raise SafetyError("the calibration is of another arm")

    for run, sentence in (
        (fake_run(checks=[refuse]), "calibration"),
        (fake_run([Fault("one_untracked", 0.0)]), "complete frames"),
        (fake_run([Fault("frozen", 0.0)]), "complete frames"),
        (fake_run([Fault("late", 0.0)]), "complete frames"),
        (fake_run([Fault("slipped", 0.0)]), "outside their range"),
    ):
        assert run.outcome.reason is R.NOT_ARMED and sentence in run.outcome.message
        assert not run.actuator.commands and run.outcome.ending is None
        check_end(run)


def test_parts_that_do_not_fit_are_refused() -> None:
    with pytest.raises(ConfigError, match="9 tendons"):
        fake_run(limits=CommandLimits(8))


KINDS = sorted({*ENDS, "jump", "wild", "turned_round", "hold_fails", "torque_off_fails"} - {"no_device", "no_sensor"})
faults = st.builds(
    lambda kind, begin, length: Fault(kind, begin, begin + length),
    st.sampled_from(KINDS),
    st.floats(0.0, 1.4),
    st.floats(0.005, 1.0),
)


@settings(max_examples=60)
@given(schedule=st.lists(faults, max_size=5), wild=st.booleans(), coarse=st.booleans())
def test_no_fault_sends_a_command_outside_the_limits(
    tmp_path_factory: pytest.TempPathFactory, schedule: list[Fault], wild: bool, coarse: bool
) -> None:
    path = tmp_path_factory.mktemp("log") / "log.mcap"
    asked = [*schedule, *[Fault("wild", 0.0)] * wild, *[Fault("coarse", 0.0)] * coarse]
    with RunLog(path.open("wb"), layouts(9, 3, 3, 9), 0.0, {"versions": {"a": "1"}}, {"config.yaml": "x: 1\n"}) as log:
        run = fake_run(asked, observers=(log,), duration=1.0)
    check_commands(run)
    check_end(run)
    # The log is whole: every event and every turn of the run is in it.
    record = read_log(path)
    assert record.complete
    assert [event["kind"] for event in record.events] == [event.kind for event in run.witness.events]
    assert record.events[-1]["reason"] == run.outcome.reason.value
    timing = record.topics.get("/timing")
    assert (0 if timing is None else len(timing)) == len(run.witness.ticks)
    if run.actuator.commands:
        rows = record.topic("/tendons")
        sure = [y for time, y, _ in run.actuator.commands if not run.actuator.faults.at("send_unsure", time)]
        assert np.array_equal(rows["sent"][rows["fresh"] == 1].reshape(-1, 9), np.array(sure).reshape(-1, 9))
