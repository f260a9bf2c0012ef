"""The examples run, short and without figures, and say what their documentation promises."""

from __future__ import annotations

import re

import pytest

from commands import example


def numbers(line: str) -> list[float]:
    return [float(number) for number in re.findall(r"-?\d+\.?\d*", line)]


def test_orientation_task() -> None:
    _, position, direction, orientation = example("orientation_task.py")
    # Millimetres, degrees, degrees, millimetres of rest length.
    assert numbers(position)[1] > 10.0
    assert numbers(direction)[1] < 5.0 and numbers(orientation)[2] < 5.0
    assert all(numbers(line)[0] < 20.0 for line in (position, direction, orientation))


def test_around_obstacle() -> None:
    blind, clear = example("around_obstacle.py")
    assert numbers(blind)[0] < 0.0 < numbers(clear)[0]
    assert numbers(blind)[-1] < 1.0 and numbers(clear)[-1] < 1.0


def test_gantry() -> None:
    equal, costly = example("gantry.py")
    for line in (equal, costly):
        assert line.endswith("limits held")
        assert numbers(line)[0] < 5.0
    # Costly rails travel less.
    assert sum(numbers(costly)[2:4]) < 0.7 * sum(numbers(equal)[2:4])


def test_tendon_limits() -> None:
    pytest.importorskip("daqp")
    free, cut, program = (numbers(line) for line in example("tendon_limits.py"))
    assert free[2] > 25.0 and cut[2] <= 25.0 and program[2] <= 25.0
    assert program[0] < 0.5 * cut[0]
