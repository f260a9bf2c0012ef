"""The position loop over velocities: no motor passes its goal, whenever the program stops."""

from __future__ import annotations

from hypothesis import given
from hypothesis import strategies as st

from apcc_torch.hardware.dynamixel.velocity_loop import VelocityLoop

TICKS_PER_UNIT = 0.229 / 60 * 4096  # ticks/s
WATCHDOG = 0.1
FASTEST = 4.0


def loop(goal: int, gain: float = 10.0) -> VelocityLoop:
    made = VelocityLoop([5], gain, FASTEST)
    made.goals[5] = goal
    return made


@given(goal=st.integers(-900_000, 900_000), start=st.integers(-900_000, 900_000), turns=st.integers(0, 30))
def test_a_motor_left_alone_at_any_turn_does_not_pass_its_goal(goal: int, start: int, turns: int) -> None:
    """A motor goes on with its last velocity until its watchdog stops it."""
    one, position = loop(goal), float(start)
    for _ in range(turns):
        one.see({5: round(position)})
        position += 0.01 * TICKS_PER_UNIT * one.take()[5]
    one.see({5: round(position)})
    end = position + WATCHDOG * TICKS_PER_UNIT * one.take()[5]
    assert min(start, goal) - 1 <= end <= max(start, goal) + 1


@given(distance=st.integers(-300, 300))
def test_a_goal_is_met_to_two_ticks(distance: int) -> None:
    """15.6 ticks/s are one unit: a shorter way than that over the gain asks for none."""
    one, position = loop(distance), 0.0
    for _ in range(3000):
        one.see({5: round(position)})
        position += 0.01 * TICKS_PER_UNIT * one.take()[5]
    assert abs(position - distance) <= 2.1


def test_no_reading_no_motion() -> None:
    one = loop(1000)
    assert one.take() == {5: 0}
    one.see({5: 0})
    assert one.take() == {5: int(FASTEST / (0.229 / 60 * 2 * 3.141592653589793))} and one.take() == {5: 0}
    one.see({})  # the motor could not be read
    assert one.take() == {5: 0}
    one.see({5: 0})
    one.reset()
    assert one.take() == {5: 0} and not one.goals
