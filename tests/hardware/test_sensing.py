"""Frames between the sensor and the controller, one by one."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from apcc_torch.errors import ApccError, ShapeError
from apcc_torch.estimation.sensor_gate import GateState, Reason
from apcc_torch.hardware.interfaces import PoseSample
from apcc_torch.hardware.mounts import Mounts
from apcc_torch.hardware.sensing import SensingSettings
from apcc_torch.hardware.stops import StopReason
from apcc_torch.lie import so3
from fake_runs import rest, sensing

ALL = np.ones(3, dtype=np.bool_)


def sample(number: int, T: np.ndarray | None = None, valid: np.ndarray = ALL) -> PoseSample:
    """Frame `number` of a source at 100 Hz; a little apart from every other one."""
    moved = (rest() if T is None else T).copy()
    moved[:, 0, 3] += 1e-6 * number
    return PoseSample(0.01 * number, number, moved, valid)


def test_a_good_frame_passes_as_it_is_and_only_once() -> None:
    sense = sensing()
    seen = sense.look(sample(1), 0.015)
    assert seen is not None and seen.complete and seen.age == pytest.approx(0.005)
    assert np.allclose(seen.T, sample(1).T, atol=1e-15)
    assert sense.look(sample(1), 0.016) is None and sense.look(None, 0.017) is None


def test_held_poses_are_the_gates_in_the_samples_frame() -> None:
    sense = sensing()
    for k in range(3):
        sense.look(sample(k), 0.01 * k)
    state = GateState(*map(torch.from_numpy, sense._judge.given[0]))
    assert np.allclose(sense._held(), sense.to_base.T @ state.poses().numpy(), atol=1e-15)


def test_a_missing_body_keeps_its_last_pose_and_its_reason() -> None:
    sense = sensing()
    first = sense.look(sample(1), 0.01)
    T = rest().copy()
    T[1] = np.nan
    seen = sense.look(sample(2, T, np.array([True, False, True])), 0.02)
    assert first is not None and seen is not None
    assert not seen.usable and seen.position_ok.tolist() == [True, False, True]
    assert seen.position_reason.tolist() == [Reason.OK, Reason.UNTRACKED, Reason.OK]
    assert np.array_equal(seen.T[1], first.T[1]) and seen.T[2, 0, 3] != first.T[2, 0, 3]
    assert first.complete and not first.position_reason.any(), "a frame stays as it was judged"


@pytest.mark.parametrize(
    ("late", "now"), [("old", 1.5), ("from the future", 0.5), ("back in time", 1.0)], ids=["old", "future", "back"]
)
def test_a_frame_out_of_time_is_not_used(late: str, now: float) -> None:
    sense = sensing()
    if late == "back in time":
        sense.look(replace(sample(101), sequence=99), 1.01)
    seen = sense.look(sample(100), now)
    assert seen is not None and not seen.usable and np.isfinite(seen.T).all()


def test_equal_frames_are_a_frozen_source_from_the_limit_on() -> None:
    sense = sensing(frozen_frames=3)
    equal = [replace(sample(1), sequence=k, stamp=0.01 * k) for k in range(1, 6)]
    seen = [sense.look(frame, frame.stamp) for frame in equal]
    assert [frame is not None and frame.usable for frame in seen] == [True, True, False, False, False]
    moving = sense.look(sample(6), 0.06)
    assert moving is not None and moving.usable
    never = sensing(frozen_frames=None)
    assert all(s is not None and s.usable for s in [never.look(frame, frame.stamp) for frame in equal])


def test_what_is_missing_is_counted_from_the_last_time_it_was_there() -> None:
    sense = sensing(stale=0.2, dropout=0.3)
    sense.begin(0.0)
    partial = np.array([True, True, False])
    for k in range(1, 29):
        sense.look(sample(k, valid=ALL if k <= 5 else partial), 0.01 * k)
        assert sense.missing(0.01 * k) is None
    assert sense.missing(0.28 + 0.06) is None
    gone = sense.missing(0.28 + 0.08)
    assert gone is not None and gone.reason is StopReason.SENSOR_DROPOUT and "body 3" in gone.message
    stale = sense.missing(0.28 + 0.21)
    assert stale is not None and stale.reason is StopReason.SENSOR_STALE


def test_limits_must_mean_something() -> None:
    for change in (
        {"max_age": 0.0},
        {"stale": -1.0},
        {"dropout": float("inf")},
        {"frozen_frames": 1},
        {"partial": "fill"},
    ):
        with pytest.raises(ApccError, match=f"^{next(iter(change))} must"):
            SensingSettings(**change)  # type: ignore[arg-type]


def test_a_sample_of_another_number_of_bodies_is_refused() -> None:
    with pytest.raises(ShapeError, match=r"T must have shape \(3, 4, 4\), got \(1, 4, 4\)"):
        sensing().look(PoseSample(0.01, 1, rest()[:1], ALL), 0.011)


FAULTS = ("missing", "nan", "inf", "zero", "mirrored", "moved", "far", "twisted", "bent", "turned")


def spoiled(sample: PoseSample, body: int, rng: np.random.Generator) -> None:
    """One of a sample's bodies with a fault of any kind."""
    fault, T = rng.choice(FAULTS), sample.T[body]
    if fault == "missing":
        T[:], sample.valid[body] = rng.choice([0.0, np.nan]), False
    elif fault in ("nan", "inf"):
        T[rng.integers(3), rng.integers(4)] = np.nan if fault == "nan" else -np.inf
    elif fault in ("zero", "mirrored"):
        T[:3, rng.integers(3)] *= 0.0 if fault == "zero" else -1.0
    elif fault in ("moved", "far"):
        T[:3, 3] += rng.normal(size=3) * (0.05 if fault == "moved" else 2.0)
    else:
        turn = {"twisted": (0.0, 0.0, 2.0), "bent": (2.5, 0.0, 0.0), "turned": rng.normal(size=3)}[fault]
        T[:3, :3] = T[:3, :3] @ so3.exp(torch.tensor(turn, dtype=torch.float64)).numpy()


@pytest.mark.parametrize("mounted", [False, True])
def test_machine_code_judges_as_the_gate_itself(mounted: bool) -> None:
    """Frames of every fault, in and out of time: the same reasons, and the same poses to rounding."""
    rng = np.random.default_rng(5)
    turns, offset = torch.from_numpy(0.1 * rng.normal(size=(3, 3))), 0.01 * rng.normal(size=(3, 3))
    mounts = Mounts(so3.exp(turns).numpy(), offset) if mounted else None
    eager, fast = sensing(mounts), sensing(mounts, machine_code=True)
    stamp, reasons, kinds = 0.0, set(), set()
    for k in range(600):
        stamp += rng.choice([0.01, 0.5, -0.01], p=[0.7, 0.25, 0.05])
        frame = sample(k, rest(), ALL.copy())
        for body in rng.permutation(3)[: rng.integers(3)]:
            spoiled(frame, body, rng)
        frame, now = replace(frame, stamp=stamp), stamp + rng.choice([0.005, 0.1], p=[0.9, 0.1])
        with np.errstate(invalid="ignore"):  # infinity times zero
            expected, seen = eager.look(frame, now), fast.look(frame, now)
        assert expected is not None and seen is not None
        for name in ("stamp", "sequence", "age", "usable", "complete"):
            assert getattr(seen, name) == getattr(expected, name), name
        for name in ("position_ok", "orientation_ok", "position_reason", "orientation_reason"):
            found, wanted = getattr(seen, name), getattr(expected, name)
            assert found.dtype == wanted.dtype and np.array_equal(found, wanted), name
        np.testing.assert_allclose(seen.T, expected.T, rtol=0, atol=1e-12)
        np.testing.assert_array_equal(fast.since_position, eager.since_position)
        reasons.update(map(Reason, seen.position_reason), map(Reason, seen.orientation_reason))
        kinds.add((seen.usable, seen.complete))
    assert reasons == set(Reason) and len(kinds) == 3
