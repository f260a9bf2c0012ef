"""The simulated arm behind the interfaces: its physics, its devices' traits, its process."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
import torch

import apcc_torch
from apcc_torch.composition.build import Builder
from apcc_torch.errors import CommunicationError, HardwareError, ValueRangeError
from apcc_torch.hardware.clock import MonotonicClock, VirtualClock
from apcc_torch.hardware.simulated import process
from apcc_torch.hardware.simulated.actuator import SimulatedActuator
from apcc_torch.hardware.simulated.actuator import SimulatedActuatorSettings as Motors
from apcc_torch.hardware.simulated.arm import SimulatedArm
from apcc_torch.hardware.simulated.board import KNOTS, Board, board_type
from apcc_torch.hardware.simulated.process import ProcessWorld
from apcc_torch.hardware.simulated.sensor import SimulatedSensor
from apcc_torch.hardware.simulated.sensor import SimulatedSensorSettings as Cameras
from apcc_torch.hardware.simulated.world import LockstepWorld
from apcc_torch.settings import names
from composed import changed


def simulated(*changes: str, step: float = 0.01, settle: float = 0.5) -> SimulatedArm:
    build = Builder(changed("dynamic_single", *changes))
    plant = build.plant(torch.tensor([0.1], dtype=torch.float64))
    return SimulatedArm(plant, build.pose_sensors(), build.sensors_at(), step, settle)


def lockstep(
    *changes: str, step: float = 0.01, settle: float = 0.5, **settings: float
) -> tuple[VirtualClock, SimulatedActuator, SimulatedSensor]:
    """Devices around one arm; settings of motors and cameras are told apart by their names."""
    clock = VirtualClock(100.0)
    world = LockstepWorld(simulated(*changes, step=step, settle=settle), clock)
    motors, cameras = ({k: v for k, v in settings.items() if k in names(t)} for t in (Motors, Cameras))
    return clock, SimulatedActuator(world, **motors), SimulatedSensor(world, **cameras)


def test_knots_are_joined_by_straight_lines() -> None:
    board = Board(np.zeros((), board_type(2, 1, 3)))
    with pytest.raises(CommunicationError, match="not begun"):
        board.tendons(0.0)
    times = 0.005 * np.arange(3 * KNOTS)
    for t in times:
        board.put_knot(t, np.array([t, 2.0 * t]), np.array([1.0, 2.0]), np.zeros(2))
    for asked in (times[-1] - 0.0123, times[-2], times[-KNOTS] + 1e-4):
        stamp, y, ydot, _ = board.tendons(asked)
        assert stamp == pytest.approx(asked) and y == pytest.approx([asked, 2.0 * asked])
        assert ydot == pytest.approx([1.0, 2.0])
    assert board.tendons(99.0)[0] == pytest.approx(times[-1]), "nothing is made up beyond the last knot"
    assert board.tendons(-1.0)[0] == pytest.approx(times[-KNOTS])


def test_motors_go_where_they_are_sent_in_ticks_and_at_their_speed() -> None:
    clock, actuator, sensor = lockstep(step=5e-3, speed=0.1, resolution=1e-4)
    with actuator, sensor:
        assert np.abs(actuator.read().y).max() == 0.0, "on its stand the tendons are at zero"
        with pytest.raises(HardwareError, match="without torque"):
            actuator.send(np.zeros(9))
        actuator.arm()
        goal = np.linspace(-0.0203, 0.0, 9)
        sent = actuator.send(goal)
        assert np.abs(sent - goal).max() <= 0.5e-4 + 1e-12
        assert np.allclose(sent / 1e-4, np.rint(sent / 1e-4), atol=1e-9)
        clock.wait_until(clock.now() + 0.11)
        halfway = actuator.read().y
        assert halfway[0] == pytest.approx(-0.0105, abs=1.5e-3), "one period's delay at most, then 0.1 m/s"
        clock.wait_until(clock.now() + 0.3)
        reading = actuator.read()
        assert np.allclose(reading.y, sent, atol=1e-12)
        assert reading.raw["position"] == [round(v) for v in sent / 1e-4]
        assert reading.stamp == pytest.approx(clock.now())


def test_rounding_to_ticks_keeps_within_what_may_be_sent() -> None:
    _, actuator, _ = lockstep(resolution=1e-4)
    last = actuator.rounded(np.linspace(-0.02, 0.0, 9), np.full(9, -1.0), np.full(9, 1.0))
    for reach in (0.0, 0.49e-4, 0.51e-4, 3.5e-4):
        for wish in (-1.0, 1.0):
            y = np.clip(wish, last - reach, last + reach)
            sent = actuator.rounded(y, last - reach, last + reach)
            assert (np.abs(sent - last) <= reach + 1e-12).all() and (np.abs(sent - y) < 1e-4).all()


def test_the_arm_is_the_plant_of_the_simulations() -> None:
    """A commanded arm settles where the plant's statics have it: B^T q follows the motors up to the compliance."""
    clock, actuator, sensor = lockstep("plant.pid.K_I=0")
    with actuator, sensor:
        actuator.arm()
        goal = np.repeat([-0.01, 0.0, 0.005], 3)
        actuator.send(goal)
        clock.wait_until(clock.now() + 4.0)
        arm = actuator.world.arm
        reading = actuator.read()
        y_arm = arm.plant.lengths(arm.now.arm.q)[0].numpy()
        assert np.abs(arm.now.arm.qdot.numpy()).max() < 1e-2
        assert reading.effort == pytest.approx(-arm.plant.pid.K_P * (reading.y - y_arm), abs=0.05)
        seen = sensor.latest()
        assert seen is not None
        truth = arm._poses(arm.now.arm.q)[0].numpy()
        assert np.abs(seen.T - truth)[:, :3, 3].max() < 1e-3


def test_without_torque_the_arm_drops() -> None:
    clock, actuator, sensor = lockstep()
    with actuator, sensor:
        actuator.arm()
        before = sensor.wait(1.0)
        clock.wait_until(clock.now() + 0.5)
        held = sensor.latest()
        actuator.torque_off()
        clock.wait_until(clock.now() + 1.0)
        dropped = sensor.latest()
        assert before is not None and held is not None and dropped is not None
        assert abs(held.T[-1, 2, 3] - before.T[-1, 2, 3]) < 2e-3
        # Slowly: the friction of the tendons in their guides holds it back.
        assert dropped.T[-1, 2, 3] < held.T[-1, 2, 3] - 3e-3
        assert actuator.read().effort == pytest.approx(np.zeros(9))


def test_frames_come_at_their_rate_and_late() -> None:
    clock, actuator, sensor = lockstep(step=5e-3, settle=0.1, rate=50.0, latency=0.013)
    with actuator, sensor:
        number = None
        stamps, delays = [], []
        for _ in range(20):
            sample = sensor.wait(1.0, number)
            assert sample is not None
            number = sample.sequence
            stamps.append(sample.stamp)
            delays.append(clock.now() - sample.stamp)
        assert np.diff(stamps) == pytest.approx(0.02)
        assert min(delays) >= 0.013 - 1e-9 and max(delays) <= 0.013 + 1e-3 + 1e-9
        assert sensor.wait(0.004, number) is None


def test_noise_and_dropout_are_the_sensors() -> None:
    _, actuator, sensor = lockstep("sensors.dropout=0.3", "sensors.position_noise=0.002", "sensors.angular_noise=0")
    with actuator, sensor:
        samples, number = [], None
        for _ in range(150):
            sample = sensor.wait(1.0, number)
            assert sample is not None
            number = sample.sequence
            samples.append(sample)
    valid = np.array([s.valid for s in samples])
    assert 0.2 < 1.0 - valid.mean() < 0.4
    T = np.array([s.T for s in samples])
    assert np.isnan(T[~valid]).all() and np.isfinite(T[valid]).all()
    x = np.where(valid, T[:, :, 0, 3], np.nan)
    assert np.nanstd(x) == pytest.approx(0.002, rel=0.25)


def test_slack_tendons_do_not_push() -> None:
    clock, actuator, sensor = lockstep("plant.transmission.slack=true", "plant.transmission.friction=0.1")
    with actuator, sensor:
        actuator.arm()
        actuator.send(np.full(9, 0.03))
        clock.wait_until(clock.now() + 1.0)
        assert actuator.read().effort.min() == 0.0


def test_lockstep_runs_are_the_same_every_time() -> None:
    def once() -> np.ndarray:
        clock, actuator, sensor = lockstep("sensors.position_noise=0.001")
        with actuator, sensor:
            actuator.arm()
            actuator.send(np.full(9, -0.01))
            clock.wait_until(clock.now() + 0.3)
            sample = sensor.latest()
            assert sample is not None
            return np.concatenate([sample.T.ravel(), actuator.read().effort])

    assert np.array_equal(once(), once())


def test_a_batch_is_no_arm() -> None:
    build = Builder(changed("dynamic_single"))
    plant = build.plant(torch.zeros(2, dtype=torch.float64))
    with pytest.raises(ValueRangeError, match="one row"):
        SimulatedArm(plant, build.pose_sensors(), build.sensors_at())
    with pytest.raises(ValueRangeError, match="rate must be positive"):
        lockstep(rate=0.0)


def test_the_process_runs_in_real_time_and_its_death_is_noticed() -> None:
    world = ProcessWorld(simulated(), MonotonicClock())
    actuator, sensor = SimulatedActuator(world), SimulatedSensor(world)
    with actuator, sensor:
        begin, first = time.monotonic(), sensor.wait(5.0)
        assert first is not None
        actuator.arm()
        actuator.send(np.full(9, -0.004))
        time.sleep(1.0)
        last = sensor.latest()
        elapsed = time.monotonic() - begin
        assert last is not None
        # Frames are numbered in real time; where the machine is busy, time goes on without the arm.
        assert 0.0 < (last.stamp - first.stamp) <= elapsed + 0.05
        assert actuator.read().y == pytest.approx(np.full(9, -0.004), abs=1e-3)
        assert world.process is not None and world.process.pid is not None
        os.kill(world.process.pid, signal.SIGKILL)
        world.process.join(5.0)
        with pytest.raises(CommunicationError, match="not running"):
            actuator.read()
        with pytest.raises(CommunicationError, match="not running"):
            sensor.latest()
        actuator.torque_off()
    assert not world.is_open


def test_an_arm_that_does_not_begin_in_time_is_told_from_one_that_ended(monkeypatch: pytest.MonkeyPatch) -> None:
    """What has to be built is built before that time begins."""
    built: list[bool] = []
    arm = simulated()
    steppers = SimulatedArm.steppers
    monkeypatch.setattr(SimulatedArm, "steppers", lambda self: built.append(True) or steppers(self))
    monkeypatch.setattr(process, "START_TIMEOUT", 0.0)
    with pytest.raises(CommunicationError, match="did not begin within 0 s"):
        ProcessWorld(arm, MonotonicClock()).open("test")
    assert built == [True]


OWNER = """
import sys
sys.path.insert(0, sys.argv[1])
from test_simulated import simulated
from apcc_torch.hardware.clock import MonotonicClock
from apcc_torch.hardware.simulated.process import ProcessWorld

if __name__ == "__main__":
    world = ProcessWorld(simulated(), MonotonicClock())
    world.open("test")
    print(world.process.pid, flush=True)
    sys.stdin.read()
"""


def test_the_process_dies_with_its_owner(tmp_path: Path) -> None:
    script = tmp_path / "owner.py"
    script.write_text(OWNER)
    here = Path(__file__).resolve()
    paths = [
        str(Path(apcc_torch.__file__).resolve().parents[1]),
        str(here.parents[1]),
        os.environ.get("PYTHONPATH", ""),
    ]
    env = os.environ | {"PYTHONPATH": os.pathsep.join(paths)}
    command = [sys.executable, str(script), str(here.parent)]
    with subprocess.Popen(command, env=env, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True) as owner:
        assert owner.stdout is not None
        arm = int(owner.stdout.readline())
        owner.kill()
    end = time.monotonic() + 10.0
    while Path(f"/proc/{arm}").exists() and time.monotonic() < end:
        time.sleep(0.05)
    assert not _runs(arm), "the arm's process is still there"


def _runs(pid: int) -> bool:
    try:
        state = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0]
    except FileNotFoundError:
        return False
    return state != "Z"
