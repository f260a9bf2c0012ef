"""The gate: every reason by a frame that has it, no lock-out, and the marker swaps of a real recording."""

from __future__ import annotations

import math
from pathlib import Path

import pytest
import torch
from scipy.spatial.transform import Rotation
from torch import Tensor

from apcc_torch.errors import ConfigError, ValueRangeError
from apcc_torch.estimation.sensor_gate import (
    GateState,
    GateVerdict,
    Reason,
    SensorGate,
    SensorGateSettings,
    gate_recording,
)
from apcc_torch.lie.rotations import rotation_angle
from apcc_torch.recordings.recording_file import load_recording
from apcc_torch.recordings.rest_pose import calibrate, poses_of
from laws import check_bad_row, check_batching, generator, uniform

ALL = torch.ones(2, dtype=torch.bool)
SENSORS = torch.tensor([0.1, 0.2], dtype=torch.float64)


def turned(*rotvec: float) -> Tensor:
    return torch.from_numpy(Rotation.from_rotvec(rotvec).as_matrix())


def frame(first: Tensor | None = None, second: Tensor | None = None) -> Tensor:
    """Two sensors' poses (2, 4, 4) at rest, their rotations given."""
    T = torch.eye(4, dtype=torch.float64).repeat(2, 1, 1)
    T[:, 2, 3] = torch.tensor([0.1, 0.2], dtype=torch.float64)
    for k, R in enumerate((first, second)):
        if R is not None:
            T[k, :3, :3] = R
    return T


def now(time: float) -> Tensor:
    return torch.tensor(time, dtype=torch.float64)


def started(gate: SensorGate) -> GateState:
    state, verdict = gate(gate.initial_state(frame(), now(0.0)), frame(), ALL, now(0.0))
    assert bool(verdict.position_ok.all()) and bool(verdict.orientation_ok.all())
    return state


def reasons(verdict: GateVerdict) -> tuple[list[int], list[int]]:
    return verdict.position_reason.tolist(), verdict.orientation_reason.tolist()


def broken(what: str) -> Tensor:
    T = frame()
    if what == "nan position":
        T[1, 0, 3] = torch.nan
    elif what == "inf rotation":
        T[1, 0, 0] = torch.inf
    elif what == "zero quaternion":
        T[1, :3, :3] = 0
    elif what == "long quaternion":
        T[1, :3, :3] *= 1.01
    elif what == "reflection":
        T[1, 0, 0] = -1
    elif what == "far":
        T[1, 0, 3] = 0.5
    elif what == "moved":
        T[1, 0, 3] = 0.05
    return T


@pytest.mark.parametrize(
    ("what", "position", "orientation"),
    [
        ("nan position", Reason.NON_FINITE, Reason.NON_FINITE),
        ("inf rotation", Reason.NON_FINITE, Reason.NON_FINITE),
        ("zero quaternion", Reason.NOT_A_ROTATION, Reason.NOT_A_ROTATION),
        ("long quaternion", Reason.NOT_A_ROTATION, Reason.NOT_A_ROTATION),
        ("reflection", Reason.NOT_A_ROTATION, Reason.NOT_A_ROTATION),
        ("far", Reason.OUT_OF_REACH, Reason.OK),
        ("moved", Reason.JUMP, Reason.OK),
    ],
)
def test_each_bad_frame_has_its_reason_and_leaves_the_other_sensor(
    what: str, position: Reason, orientation: Reason
) -> None:
    gate = SensorGate(SENSORS)
    state, verdict = gate(started(gate), broken(what), ALL, now(0.01))
    assert reasons(verdict) == ([Reason.OK, position], [Reason.OK, orientation])
    assert bool(state.poses().isfinite().all())
    torch.testing.assert_close(state.poses(), frame())
    assert state.position_time.tolist() == [0.01, 0.01 if position == Reason.OK else 0.0]


def test_untracked() -> None:
    gate = SensorGate(SENSORS)
    _, verdict = gate(started(gate), frame() * torch.nan, torch.tensor([False, True]), now(0.01))
    assert reasons(verdict) == ([Reason.UNTRACKED, Reason.NON_FINITE], [Reason.UNTRACKED, Reason.NON_FINITE])
    assert not bool(verdict.position_ok.any())


def test_what_an_arm_cannot_do() -> None:
    gate = SensorGate(SENSORS, max_bend=1.0, max_twist=0.5)
    state = gate.initial_state(frame(), now(0.0))

    def orientation(first: Tensor, second: Tensor) -> list[int]:
        return gate(state, frame(first, second), ALL, now(0.0))[1].orientation_reason.tolist()

    assert orientation(turned(0.9, 0, 0), turned(1.8, 0, 0)) == [Reason.OK, Reason.OK]
    assert orientation(turned(1.1, 0, 0), turned(0, 0, 0)) == [Reason.TOO_BENT, Reason.OK]
    assert orientation(turned(0.9, 0, 0), turned(-0.2, 0, 0)) == [Reason.OK, Reason.TOO_BENT]
    # With the first not accepted, the second is held against the base, both bends allowed.
    assert orientation(turned(1.1, 0, 0), turned(1.9, 0, 0)) == [Reason.TOO_BENT, Reason.OK]
    assert orientation(turned(1.1, 0, 0), turned(2.1, 0, 0)) == [Reason.TOO_BENT, Reason.TOO_BENT]
    # A twist is told from a tilt of any direction.
    tilt = turned(0.5, -0.6, 0)
    assert orientation(tilt @ turned(0, 0, 0.4), tilt @ turned(0, 0, 0.6)) == [Reason.OK, Reason.TWISTED]
    assert orientation(turned(0, 0, -0.6), tilt) == [Reason.TWISTED, Reason.OK]


def test_a_jump_is_held_back_and_a_true_move_is_found_again() -> None:
    gate = SensorGate(SENSORS, max_angular_rate=2.0, angle_margin=0.1, max_speed=1.0, position_margin=0.01)
    state, moved = started(gate), frame(None, turned(0.5, 0, 0))
    moved[1, 0, 3] = 0.1
    accepted = []
    for i in range(1, 31):
        state, verdict = gate(state, moved, ALL, now(0.01 * i))
        accepted.append((bool(verdict.position_ok[1]), bool(verdict.orientation_ok[1])))
    # 0.1 m <= 0.01 + 1.0 t from t = 0.09 s on; 0.5 rad <= 0.1 + 2.0 t from t = 0.2 s on.
    assert [p for p, _ in accepted].index(True) in (8, 9) and [o for _, o in accepted].index(True) in (19, 20)
    assert accepted[20:] == [(True, True)] * 10


def test_a_swap_that_stays_is_never_followed_where_an_arm_cannot_do_it() -> None:
    gate = SensorGate(SENSORS)
    state, swapped = started(gate), frame(None, turned(0, math.pi, 0))
    for i in range(1, 300):
        state, verdict = gate(state, swapped, ALL, now(0.1 * i))
        assert verdict.orientation_ok.tolist() == [True, False] and bool(verdict.position_ok.all())
    state, verdict = gate(state, frame(), ALL, now(40.0))
    assert bool(verdict.orientation_ok.all())


def test_repeated_and_backward_stamps_allow_no_more_than_the_margin() -> None:
    gate = SensorGate(SENSORS, position_margin=0.02)
    for time in (0.0, -5.0):
        near, far = frame(), frame()
        near[:, 0, 3], far[:, 0, 3] = 0.019, 0.021
        assert bool(gate(started(gate), near, ALL, now(time))[1].position_ok.all())
        assert not bool(gate(started(gate), far, ALL, now(time))[1].position_ok.any())


def test_batching_and_bad_rows() -> None:
    gate = SensorGate(torch.ones(3, dtype=torch.float64), reach=2.0)

    def op(turns: Tensor, places: Tensor) -> tuple[GateState, GateVerdict]:
        """Three frames made of rotation angles (..., 3 frames, 3 sensors) and places (..., 3 frames, 3 sensors, 3)."""
        o = torch.zeros_like(turns)
        c, s = turns.cos(), turns.sin()
        R = torch.stack((c, o, s, o, o + 1, o, -s, o, c), dim=-1).unflatten(-1, (3, 3))
        top = torch.cat((R, places.unsqueeze(-1)), dim=-1)
        T = torch.cat((top, top.new_tensor([0.0, 0, 0, 1]).expand(*top.shape[:-2], 1, 4)), dim=-2)
        time = T.new_zeros(T.shape[:-4])
        tracked = torch.ones((*T.shape[:-4], 3), dtype=torch.bool)
        state = gate.initial_state(T[..., 0, :, :, :], time)
        for i in range(3):
            state, verdict = gate(state, T[..., i, :, :, :], tracked, time + 0.01 * i)
        return state, verdict

    def make(shape: tuple[int, ...], dtype: torch.dtype, rng: torch.Generator) -> tuple[Tensor, Tensor]:
        return uniform((*shape, 3, 3), -0.3, 0.3, dtype, rng), uniform((*shape, 3, 3, 3), -0.02, 0.02, dtype, rng)

    check_batching(op, make)
    check_bad_row(op, make((5,), torch.float64, generator()))


@pytest.mark.parametrize(
    ("keywords", "error", "named"),
    [
        ({"reach": 0.0}, ValueRangeError, "reach"),
        ({"max_speed": 0.0}, ValueRangeError, "max_speed"),
        ({"max_twist": math.nan}, ValueRangeError, "max_twist"),
        ({"max_bend": [1.0, 1.0, 1.0]}, ConfigError, "max_bend"),
        ({"rotation_tolerance": 0.0}, ValueRangeError, "rotation_tolerance"),
    ],
)
def test_bad_settings_are_named(keywords: dict[str, object], error: type[Exception], named: str) -> None:
    with pytest.raises(error, match=f"^{named} must"):
        SensorGate(SENSORS, **keywords)


def test_half_a_turn_and_no_reach_switch_a_check_off() -> None:
    gate = SensorGate(SENSORS, max_bend=[math.pi, 1.0], max_twist=math.pi, reach=None)
    state = gate.initial_state(frame(), now(0.0))
    _, verdict = gate(state, frame(turned(3.1, 0, 0), turned(1.9, 0, 0)), ALL, now(0.0))
    assert verdict.orientation_reason.tolist() == [Reason.OK, Reason.TOO_BENT]
    _, verdict = gate(state, frame(turned(0, 0, 3.1), turned(0, 0, 2.9)), ALL, now(0.0))
    assert verdict.orientation_reason.tolist() == [Reason.OK, Reason.OK]


def test_a_saved_gate_comes_back_with_every_limit() -> None:
    gate = SensorGate(SENSORS, max_speed=3.0, max_bend=[1.0, 2.0], reach=None)
    other = SensorGate(0.5 * SENSORS)
    other.load_state_dict(gate.state_dict())
    assert (other.max_speed, other.reach) == (3.0, None) and "max_speed=3.0" in repr(other)
    for name, value in gate.named_buffers():
        assert torch.equal(other.get_buffer(name), value), name
    assert SensorGate(SENSORS, SensorGateSettings(max_twist=0.5)).max_twist.tolist() == [0.5, 0.5]


# Stretches of the recording, and how many frames in each have disk 3 swapped, counted by hand from its jumps.
@pytest.mark.parametrize(("first", "last", "disk3"), [(240, 620, 0), (3400, 4000, 36 + 10 + 5)])
def test_the_marker_swaps_of_the_recorded_trunk_are_gated(first: int, last: int, disk3: int, shared_data: Path) -> None:
    recording = load_recording(shared_data / "trunk", layout="trunk")
    c = calibrate(recording, direction=(0.0, -1.0, 0.0))
    T = poses_of(c, recording)
    # Swapped, by the disks themselves: disk 2 is turned by over 110 degrees against disk 1, which is never swapped.
    swapped = rotation_angle(T[:, 0, :3, :3], T[:, 1, :3, :3]) > 1.92
    assert int(swapped.sum()) == 1048
    gate = SensorGate(c.abscissae)
    window = slice(first, last)
    held, verdict = gate_recording(gate, T[window], recording.tracked[window], recording.times[window])
    assert torch.equal(~verdict.orientation_ok[:, 1], swapped[window])
    twisted = (verdict.orientation_reason == Reason.TWISTED).sum(0)
    assert twisted.tolist() == [0, int(swapped[window].sum()), disk3]
    assert bool(verdict.position_ok.all())
    # What is handed on never turns by more than an arm can between two frames, short of the catch-up after a swap.
    step = rotation_angle(held[1:, :, :3, :3], held[:-1, :, :3, :3])
    assert float(step.max()) < 0.45
