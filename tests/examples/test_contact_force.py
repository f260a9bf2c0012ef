"""The example runs in its reduced form: it weighs, finds the place and the force, and says where it cannot."""

from __future__ import annotations

import re

from commands import example


def numbers(line: str) -> list[float]:
    return [float(number) for number in re.findall(r"-?\d+\.?\d*", line)]


def test_quick() -> None:
    payload, place, force, evidence = example("contact_force.py")
    true, estimated, deviation = numbers(payload)
    assert abs(estimated - true) < 3.0 * deviation < 30.0
    true, estimated, low, high = numbers(place)
    assert abs(estimated - true) < 3.0 and low <= true <= high and place.endswith("cm: located")
    assert numbers(force)[-1] < 0.2
    assert numbers(evidence)[0] > 100.0 and numbers(evidence)[1] > 30.0


def test_what_the_noise_hides_is_not_located() -> None:
    _, place, _, _ = example("contact_force.py", "--force", "0.1")
    assert place.endswith("not located")
