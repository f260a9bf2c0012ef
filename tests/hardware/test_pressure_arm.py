"""The simulated arm with chambers behind the interfaces, and the whole runner on it."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from apcc_torch.composition.realtime import RealtimeSettings
from apcc_torch.errors import ApccError
from apcc_torch.experiments import realtime_run as realtime
from apcc_torch.experiments import replay
from apcc_torch.hardware.limits import CommandLimits, PressureLimitSettings
from apcc_torch.hardware.log_export import write_recording
from apcc_torch.hardware.log_reader import read_log
from apcc_torch.hardware.simulated.actuator import SimulatedRegulators
from apcc_torch.hardware.stops import StopReason
from apcc_torch.model.arm import Arm
from apcc_torch.recordings.recording_file import load_recording
from composed import composed as composed_simulate
from composed import composed_realtime

ON_AIR = (
    "arm=soft_trunk", "hardware=lockstep", "view=false", "figures=false", "compile=off", "loop.hold=0.1",
    "loop.warm_up=5", "plant.settle=0.5", "hardware.world.step=0.01",
)  # fmt: skip
CHAMBERS = Arm.load("soft_trunk").chambers


def composed(*words: str) -> RealtimeSettings:
    return composed_realtime("experiment=setpoint", *ON_AIR, *words)


def test_pressures_are_clamped_within_the_arms_own() -> None:
    assert CHAMBERS is not None
    limits = CommandLimits.of_chambers(CHAMBERS.force(2), PressureLimitSettings(step=1e4))
    assert limits.lower.tolist() == [0.0] * 6 and limits.upper.tolist() == [1.2e5] * 6
    y, low, high = limits.clamp(np.full(6, 9e4), (np.full(6, 5e4), 1.0))
    assert y == pytest.approx(6e4) and low == pytest.approx(4e4) and high == pytest.approx(6e4)
    assert limits.shown(np.array([12345.0])) == "[12.3] kPa" and limits.inside(np.full(6, 1.25e5), limits.margin or 0.0)


def test_a_run_moves_the_arm_by_pressure_and_replays(tmp_path: Path) -> None:
    outcome, metrics = realtime.run(composed("experiment.duration=0.8"), tmp_path)
    assert outcome.reason is StopReason.DURATION, outcome.message
    assert metrics["end_effector_error_end_mm"] < 0.9 * metrics["end_effector_error_start_mm"]
    log = read_log(tmp_path / "log.mcap")
    tendons = log.topic("/tendons")
    sent, p = tendons["sent"], tendons["y"]
    assert sent.min() >= 0.0 and sent.max() <= 1.2e5 and np.abs(np.diff(sent, axis=0)).max() <= 2e4 + 50.0
    assert (tendons["effort"] == 0.0).all(), "no regulator tells a tension"
    # The valves' lag of 0.05 s lies between what was sent and what was read.
    assert 500.0 < np.abs(sent[1:] - p[1:]).max() < 6e4
    assert realtime.replay_log(log).difference <= 1e-9

    # What goes out of it as a recording has pressures as they stand, and the frames that `replay` reads.
    assert log.of_pressures
    recording = load_recording(write_recording(log, tmp_path / "recording.csv"))
    assert recording.inputs is not None and recording.actuators is not None
    frames = log.topic("/measurement")
    frames = frames[np.unique(frames["sequence"], return_index=True)[1]]
    at = {int(row["tick"]): row for row in tendons}
    told = [k for k, tick in enumerate(frames["tick"].tolist()) if tick in at]
    assert len(told) > 20
    for k in told:
        row = at[int(frames["tick"][k])]
        assert recording.inputs[k].tolist() == pytest.approx(row["sent"], abs=1e-6)
        assert recording.actuators[k].tolist() == pytest.approx(row["y"], abs=1e-6)
    assert recording.inputs.min() >= 0.0 and recording.inputs.max() > 2e4
    words = "experiment=replay", f"data={tmp_path / 'recording.csv'}", "arm=soft_trunk", "figures=false", "compile=off"
    (tmp_path / "replay").mkdir()
    assert replay.run(composed_simulate(*words), tmp_path / "replay")["sensor_error_linear_mean_mm"] < 5.0


def test_the_chambers_are_vented_without_torque_and_hold_when_held() -> None:
    build = realtime.RealtimeBuilder(composed())
    devices = build.devices()
    actuator, clock = devices.actuator, devices.world.clock
    assert isinstance(actuator, SimulatedRegulators) and actuator.sets_pressure and not actuator.needs_calibration
    with actuator:
        assert actuator.read().y == pytest.approx(2e4, abs=50.0), "on its stand, the pressure of rest"
        actuator.arm()
        assert actuator.send(np.full(6, 40_020.0)) == pytest.approx(4e4)
        clock.wait_until(clock.now() + 0.05)
        lag = actuator.read().y
        assert ((lag > 2.5e4) & (lag < 3.8e4)).all()
        actuator.hold()
        clock.wait_until(clock.now() + 0.3)
        assert actuator.read().y == pytest.approx(lag, abs=2e3)
        actuator.torque_off()
        clock.wait_until(clock.now() + 0.5)
        assert np.abs(actuator.read().y).max() < 200.0


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (("guards.pressures.lower=2e5",), r"guards\.pressures.*lower must be below upper"),
        (("guards.pressures.upper=[1e5]",), r"guards\.pressures.*upper must have 6 entries"),
    ],
)
def test_limits_that_are_none_are_refused(words: tuple[str, ...], said: str) -> None:
    with pytest.raises(ApccError, match=said):
        composed(*words)
