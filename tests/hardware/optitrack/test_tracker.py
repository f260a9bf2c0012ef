"""From frames to samples, without a network: order, clocks, gates and the base, on a clock of the test's own."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from apcc_torch.hardware.mocap.gate import Reason
from apcc_torch.hardware.mocap.tracker import MocapSample
from hardware.emulators.mocap_server import standing
from hardware.optitrack.streams import EXPOSURE, IDS, RATE, TRANSPORT, Stream, settings

OK = Reason.OK


def expected(poses: np.ndarray) -> np.ndarray:
    """Bodies (k - 1, 4, 4) in the base frame, 20.5 mm along z of the first one's; by scipy."""
    rotation, position = Rotation.from_quat(poses[:, 3:]), poses[:, :3]
    T = np.tile(np.eye(4), (len(poses) - 1, 1, 1))
    T[:, :3, :3] = (rotation[0].inv() * rotation[1:]).as_matrix()
    T[:, :3, 3] = rotation[0].inv().apply(position[1:] - position[0]) - (0, 0, 0.0205)
    return T


def invalid(sample: MocapSample, *bodies: int) -> bool:
    """Whether exactly these bodies are not valid, and hold NaN."""
    wrong = [k for k in range(3) if not sample.valid[k]]
    return (
        wrong == list(bodies)
        and bool(np.isnan(sample.T[wrong]).all())
        and bool(np.isfinite(sample.T[sample.valid]).all())
    )


@pytest.mark.parametrize("static", [True, False])
def test_poses_are_in_the_base_frame(static: bool) -> None:
    poses = standing(4)
    poses[:, 3:] = Rotation.random(4, random_state=5).as_quat()
    stream = Stream(settings(static_base=static), poses=poses)
    sample = stream.run(3)
    assert invalid(sample) and sample.reasons == (OK,) * 3 and sample.base_reason is OK
    np.testing.assert_allclose(sample.T, expected(poses), atol=1e-4)
    assert stream.tracker.base is not None
    np.testing.assert_allclose(
        stream.tracker.base[:3, 3], poses[0, :3] + Rotation.from_quat(poses[0, 3:]).apply([0, 0, 0.0205]), atol=1e-4
    )


def test_the_scale_makes_metres_also_for_the_gate() -> None:
    poses = standing(4)
    poses[:, :3] *= 1e3
    stream = Stream(settings(scale=1e-3), poses=poses, noise=0.01)
    np.testing.assert_allclose(stream.run(10).T, expected(standing(4)), atol=1e-4)
    poses[1, 0] += 15.0  # mm: within 0.01 m and one frame at 1 m/s
    assert invalid(stream.step(poses))


def test_a_sample_cannot_be_written_to() -> None:
    sample = Stream().step()
    for array in (sample.T, sample.valid):
        with pytest.raises(ValueError, match="read-only"):
            array[0] = 0
    with pytest.raises(dataclasses.FrozenInstanceError):
        sample.stamp = 0.0  # type: ignore[misc]


def test_stamps_are_the_exposures_in_our_clock() -> None:
    stream = Stream()
    for _ in range(100):
        sample = stream.step()
        # All that is not seen is the delay of the fastest packet.
        assert sample.stamp - (stream.now - EXPOSURE) == pytest.approx(TRANSPORT, abs=1e-5)
    stream = Stream(settings(latency=0.003), ticks=False)
    assert stream.run(10).stamp - stream.now == pytest.approx(TRANSPORT - 0.003, abs=1e-5)


def test_stamps_never_go_back_as_the_clocks_become_known() -> None:
    stream, stamps = Stream(), []
    for delay in (0.09, 0.05, 0.03, 0.001, 0.0002, 0.02, 0.0002):
        sample = stream.take(stream.frame(), delay)
        assert sample is not None
        stamps.append(sample.stamp)
    assert (np.diff(stamps) > 0).all()


def test_a_late_frame_is_not_valid_but_the_next_one_is() -> None:
    stream = Stream()
    stream.run(10)
    for delay in (0.2, 5.0):
        sample = stream.take(stream.frame(), delay)
        assert sample is not None and invalid(sample, 0, 1, 2) and sample.reasons == (Reason.LATE,) * 3
        assert sample.stamp == pytest.approx(stream.now - EXPOSURE, abs=1e-3)
        stream.now += delay
        assert invalid(stream.step())
    assert (stream.counts.late, stream.counts.clock_steps) == (2, 0)


def test_a_repeated_frame_number_is_no_sample() -> None:
    stream = Stream()
    stream.run(3)
    frame = stream.frame()
    assert stream.take(frame) is not None
    for _ in range(4):
        stream.now += 1 / RATE
        assert stream.take(dataclasses.replace(stream.frame(), sequence=frame.sequence)) is None
    assert (stream.counts.repeated, stream.tracker.repeats, stream.counts.frames) == (4, 4, 4)
    stream.step()
    assert stream.tracker.repeats == 0


def test_frames_out_of_order_are_dropped_and_missed_ones_counted() -> None:
    stream = Stream()
    stream.run(3)
    one, two = stream.frame(), stream.frame()
    assert stream.take(two) is not None and stream.take(one) is None
    stream.sequence += 5
    assert invalid(stream.step())
    assert (stream.counts.out_of_order, stream.counts.missed, stream.counts.restarts) == (1, 6, 0)


def test_a_source_that_begins_anew_is_followed_with_doubt() -> None:
    stream = Stream(settings(recovery_frames=3))
    stream.run(50)
    stream.sequence, stream.clock_step = 0, -4000.0
    taken = [stream.take(stream.frame()) for _ in range(6)]
    assert [sample is None for sample in taken] == [True, True, False, False, False, False]
    assert [sample.reasons[0] for sample in taken if sample] == [Reason.RECOVERING, Reason.RECOVERING, OK, OK]
    assert (stream.counts.restarts, stream.counts.out_of_order) == (1, 2)
    last = taken[-1]
    assert last is not None and last.stamp == pytest.approx(stream.now - EXPOSURE + TRANSPORT, abs=1e-5)


@pytest.mark.parametrize("step", [3.0, -3.0])
def test_a_clock_that_was_set_costs_a_few_frames_at_most(step: float) -> None:
    stream = Stream()
    stream.run(20)
    stream.clock_step = step
    stamps = []
    for _ in range(10):
        sample = stream.step()
        stamps.append(sample.stamp)
        assert sample.stamp <= stream.now + TRANSPORT + 1e-4
    assert stream.counts.clock_steps == 1 and invalid(sample)
    assert sample.stamp == pytest.approx(stream.now - EXPOSURE + TRANSPORT, abs=1e-5)
    assert (np.diff(stamps) > 0).all()


def test_bodies_have_their_reasons_and_are_counted_by_name() -> None:
    stream = Stream()
    stream.run(3)
    assert invalid(stream.step(untracked=(2,)), 0)
    frame = stream.frame()
    del frame.bodies[3]
    frame.bodies[4] = dataclasses.replace(frame.bodies[4], quaternion=(0.0, 0.0, 0.0, 0.0))
    sample = stream.take(frame)
    assert sample is not None and sample.reasons == (OK, Reason.MISSING, Reason.BAD_QUATERNION)
    assert invalid(sample, 1, 2)
    assert stream.counts.bodies == {
        "disk_1": {"untracked": 1},
        "disk_2": {"missing": 1},
        "disk_3": {"bad_quaternion": 1},
    }
    assert stream.counts.copy() == stream.counts


def test_a_moving_base_that_is_lost_takes_all_with_it() -> None:
    stream = Stream(settings(static_base=False))
    stream.run(3)
    sample = stream.step(untracked=(1,))
    assert invalid(sample, 0, 1, 2) and sample.reasons == (Reason.BASE,) * 3
    assert sample.base_reason is Reason.UNTRACKED
    assert invalid(stream.step())


def test_a_static_base_is_measured_once_and_may_then_be_lost() -> None:
    stream = Stream(settings(base_frames=5))
    reasons = [stream.step().base_reason for _ in range(6)]
    assert reasons == [Reason.BASE] * 4 + [OK] * 2
    base = stream.tracker.base
    assert base is not None and not base.flags.writeable
    sample = stream.step(untracked=(1,))
    assert invalid(sample) and sample.base_reason is OK and stream.tracker.base is base
    np.testing.assert_allclose(sample.T, expected(standing(4)), atol=1e-4)


def test_a_static_base_that_moves_while_it_is_measured() -> None:
    stream, poses = Stream(settings(base_frames=5)), standing(4)
    for i in range(5):
        poses[0, 0] = 0.3 + 0.004 * i
        sample = stream.step(poses)
    assert stream.tracker.base is None and "moved while it was measured" in str(stream.tracker.base_error)
    assert sample.reasons == (Reason.BASE,) * 3
    for _ in range(5):
        sample = stream.step(poses)
    assert stream.tracker.base is not None and stream.tracker.base_error is None and invalid(sample)


def test_a_static_base_that_is_pushed_takes_all_with_it() -> None:
    stream, poses = Stream(settings(recovery_frames=3)), standing(4)
    stream.run(3)
    poses[:, 0] += 0.008  # beyond the base's tolerance of 3 mm, within what may be a jump
    reasons = [stream.step(poses).reasons[0] for _ in range(4)]
    assert reasons == [OK, OK, Reason.BASE, Reason.BASE]
    assert stream.run(2).reasons == (OK,) * 3


def test_an_earlier_base_is_kept_and_held_against_what_is_seen() -> None:
    first = Stream()
    first.run(3)
    again = Stream(base=first.tracker.base)
    assert invalid(again.step())
    moved = standing(4)
    moved[:, 1] += 0.01
    other = Stream(base=first.tracker.base, poses=moved)
    assert other.run(10).reasons == (Reason.BASE,) * 3


def test_a_new_stream_asks_for_a_new_proof() -> None:
    stream = Stream(settings(recovery_frames=3))
    stream.run(3)
    stream.tracker.begin(dict(IDS))
    stream.sequence, stream.clock_step = 0, -4000.0  # nothing of this is doubted
    assert [stream.step().reasons[0] for _ in range(3)] == [Reason.RECOVERING, Reason.RECOVERING, OK]
    assert (stream.counts.restarts, stream.counts.clock_steps) == (0, 0)
    stream.tracker.begin({**IDS, "disk_1": IDS["disk_2"], "disk_2": IDS["disk_1"]})
    reasons = [stream.step().reasons for _ in range(10)]
    assert all(r[0] is Reason.SWAPPED and r[1] is Reason.SWAPPED for r in reasons) and reasons[-1][2] is OK
