"""The gate: every reason by a frame that has it, recovery, and swaps that are never followed."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from apcc_torch.hardware.mocap.bodies import BodyPose
from apcc_torch.hardware.mocap.gate import BodyGate, Reason
from hardware.emulators.mocap_server import standing
from hardware.optitrack.streams import body, settings

OK, JUMP, RECOVERING, SWAPPED = Reason.OK, Reason.JUMP, Reason.RECOVERING, Reason.SWAPPED
DT = 0.01


class Player:
    """Plays frames of three bodies to a gate, 0.01 s apart; every frame has numbers of its own."""

    def __init__(self, **limits: object) -> None:
        self.gate, self.time, self.rows = BodyGate(3, settings(**limits)), 0.0, standing(3)
        self.random = np.random.default_rng(0)

    def bodies(self) -> list[BodyPose | None]:
        rows = self.rows.copy()
        rows[:, :3] += self.random.normal(0, 1e-5, (3, 3))
        return [body(row) for row in rows]

    def play(self, bodies: Sequence[BodyPose | None] | None = None) -> list[Reason]:
        self.time += DT
        return self.gate.judge(self.bodies() if bodies is None else bodies, self.time)

    def play_second(self, changed: BodyPose | None) -> Reason:
        """The reason of the second body, all others as they should be."""
        bodies = self.bodies()
        bodies[1] = changed
        reasons = self.play(bodies)
        assert (reasons[0], reasons[2]) == (OK, OK)
        return reasons[1]


def broken(what: str) -> BodyPose | None:
    row = standing(3)[1]
    if what == "missing":
        return None
    if what == "nan":
        row[0] = math.nan
    elif what == "inf":
        row[4] = math.inf
    elif what == "zero":
        row[3:] = 0.0
    elif what == "long":
        row[3:] *= 1.01
    return body(row, tracked=what != "untracked")


EVIDENT = [
    ("missing", Reason.MISSING),
    ("untracked", Reason.UNTRACKED),
    ("nan", Reason.NON_FINITE),
    ("inf", Reason.NON_FINITE),
    ("zero", Reason.BAD_QUATERNION),
    ("long", Reason.BAD_QUATERNION),
]


@pytest.mark.parametrize(("what", "reason"), EVIDENT)
def test_a_bad_body_has_its_reason_and_leaves_the_others(what: str, reason: Reason) -> None:
    player = Player()
    assert player.play() == [OK] * 3
    for _ in range(3):
        assert player.play_second(broken(what)) == reason
    assert player.play() == [OK] * 3  # it is where it was: nothing is held back


def test_the_very_same_numbers_are_frozen() -> None:
    player, same = Player(frozen_frames=4), body(standing(3)[1])
    assert [player.play_second(same) for _ in range(6)] == [OK] * 3 + [Reason.FROZEN] * 3
    assert player.play() == [OK] * 3
    player = Player(frozen_frames=0)
    assert [player.play_second(same) for _ in range(60)] == [OK] * 60


@pytest.mark.parametrize("what", ["position", "rotation"])
def test_a_jump_is_held_until_enough_frames_agree(what: str) -> None:
    player = Player(recovery_frames=4)
    player.play()
    if what == "position":
        player.rows[1, :3] += (0.06, 0, 0)
    else:
        player.rows[1, 3:] = Rotation.from_rotvec([0, 1.0, 0]).as_quat()
    assert [player.play()[1] for _ in range(6)] == [JUMP, RECOVERING, RECOVERING, OK, OK, OK]


def test_one_wild_frame_and_a_body_that_never_settles() -> None:
    player = Player(recovery_frames=3)
    player.play()
    good, wild = player.rows[1].copy(), player.rows[1].copy()
    wild[0] += 0.5
    assert player.play_second(body(wild)) == JUMP
    assert [player.play()[1] for _ in range(4)] == [RECOVERING, RECOVERING, OK, OK]
    flicker = [player.play_second(body(row)) for row in [wild, good] * 10]
    assert OK not in flicker


def test_a_gap_interrupts_the_recovery() -> None:
    player = Player(recovery_frames=3)
    player.play()
    player.rows[1, 0] += 0.06
    assert [player.play()[1] for _ in range(2)] == [JUMP, RECOVERING]
    assert player.play_second(broken("untracked")) == Reason.UNTRACKED
    assert player.play()[1] != OK and player.play()[1] != OK and player.play()[1] == OK


@given(speed=st.floats(0.0, 3.0), turn=st.floats(0.0, 40.0), seed=st.integers(0, 2**31))
def test_what_moves_within_the_limits_is_never_refused(speed: float, turn: float, seed: int) -> None:
    """Steady motion in any direction; the gate's limits are 1 m/s and 0.01 m, 8 rad/s and 0.15 rad."""
    rng = np.random.default_rng(seed)
    direction, axis = (v / np.linalg.norm(v) for v in rng.normal(size=(2, 3)))
    player, start = Player(swap_radius=1e-6), Rotation.random(random_state=seed)
    refused = False
    for i in range(20):
        player.rows[1, :3] = standing(3)[1, :3] + i * DT * speed * direction
        player.rows[1, 3:] = (start * Rotation.from_rotvec(i * DT * turn * axis)).as_quat() * (-1) ** i
        refused |= player.play()[1] is not OK
    allowed = speed * DT < 0.01 + 1.0 * DT - 1e-4 and turn * DT < 0.15 + 8.0 * DT - 1e-6
    forbidden = speed * DT > 0.01 + 1.0 * DT + 1e-4 or turn * DT > 0.15 + 8.0 * DT + 1e-6
    assert not (refused and allowed) and (refused or not forbidden)


def test_a_body_out_of_sight_gains_no_more_way_than_a_short_gap_allows() -> None:
    for away, expected in ((0.1, OK), (0.13, JUMP)):  # 0.01 m + 1 m/s * 0.1 s, even after 2 s
        player = Player(swap_radius=1e-3)
        player.play()
        for _ in range(200):
            assert player.play_second(broken("untracked")) == Reason.UNTRACKED
        player.rows[1, 1] += away
        assert player.play()[1] == expected


def swapped(bodies: list[BodyPose | None]) -> list[BodyPose | None]:
    return [bodies[0], bodies[2], bodies[1]]


def test_a_swap_is_never_followed_and_ends_with_it() -> None:
    player = Player()
    player.play()
    for i in range(300):  # the arm moves on meanwhile: by 0.3 m in all
        player.rows[:, 0] += 0.001
        assert player.play(swapped(player.bodies())) == [OK, SWAPPED, SWAPPED], i
    expected = [[OK, RECOVERING, RECOVERING]] * 4 + [[OK, OK, OK]]
    # Back where they were seen last under the other's name, but far from their own last accepted pose.
    assert [[OK if r is OK else RECOVERING for r in player.play()] for _ in range(5)] == expected


def test_a_swap_of_two_bodies_that_come_back_from_out_of_sight() -> None:
    player = Player()
    player.play()
    for _ in range(30):
        assert player.play([player.bodies()[0], None, None]) == [OK, Reason.MISSING, Reason.MISSING]
    # 0.3 s without sight allow 0.11 m of way, and the bodies are 0.12 m apart: only identity tells.
    player.rows[2, 2] += 0.015
    assert player.play(swapped(player.bodies())) == [OK, SWAPPED, SWAPPED]


def test_a_name_that_goes_to_a_body_that_has_lost_its_own() -> None:
    player = Player()
    player.play()
    for _ in range(100):
        player.rows[:, 1] -= 0.002
        bodies = player.bodies()
        assert player.play([bodies[0], bodies[2], None]) == [OK, SWAPPED, Reason.MISSING]
        assert player.play([bodies[0], bodies[2], bodies[2]])[1] == SWAPPED


def test_distrust_asks_for_a_new_proof() -> None:
    player = Player(recovery_frames=3)
    player.play()
    player.gate.distrust()
    assert [player.play() for _ in range(3)] == [[RECOVERING] * 3, [RECOVERING] * 3, [OK] * 3]


def test_stamps_that_stand_or_go_back_allow_the_margin_only() -> None:
    for time in (0.0, -5.0):
        for away, expected in ((0.009, OK), (0.011, JUMP)):
            gate, rows = BodyGate(3, settings()), standing(3)
            gate.judge([body(row) for row in rows], 0.0)
            rows[1, 0] += away
            assert gate.judge([body(row) for row in rows], time)[1] == expected
