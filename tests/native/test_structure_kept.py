"""What is kept of a module serves others of its structure with their own numbers, and none of another structure."""

from __future__ import annotations

import copy
import math
import random
from collections.abc import Iterator
from typing import Any

import pytest
import torch
from torch import Tensor, nn

from apcc_torch import APCCController, Arm, Measurement, Target, decouple
from apcc_torch.native.fingerprint import fingerprint
from apcc_torch.native.function import NativeFunction
from laws import generator, worst

D = torch.float64
LENGTHS = (0.105, 0.255, 0.24)
PLACES = ("abscissae", "anchors", "lengths", "nominal")
pytestmark = pytest.mark.usefixtures("own_cache")


class Spring(nn.Module):
    """A function of what it holds that takes its form from signs and sums, as an arm's does."""

    def __init__(self, lengths: list[float], gain: float = 0.3, order: int = 2, dtype: torch.dtype = D) -> None:
        super().__init__()
        self.register_buffer("lengths", torch.tensor(lengths, dtype=dtype))
        self.register_buffer("which", torch.tensor([1, 0]))
        self.gain, self.order = gain, order

    def forward(self, x: Tensor) -> Tensor:
        reach = (self.lengths.sum() - 1.0).clamp(min=0.0)
        stretched = torch.where(self.lengths > 0.5, self.lengths.sqrt(), -self.lengths)
        return (self.gain * stretched[self.which] * x.sin()) ** self.order + reach * x.flip(0)


X = torch.tensor([0.4, -0.7], dtype=D)


def test_other_numbers_are_not_traced_again(counted: dict[str, int]) -> None:
    for k in range(6):
        module = Spring([0.55 + 0.05 * k, 0.1 + 0.01 * k])
        for x in (X, torch.stack((X, 2.0 * X, 3.0 * X))):
            assert worst(NativeFunction(module, (X,))(x), torch.vmap(module)(x) if x.dim() > 1 else module(x)) < 1e-15
    # One for lanes, one for one row: where one is known, neither is traced.
    assert counted == {"traced": 2, "built": 2}


@pytest.mark.parametrize(
    ("change", "again"),
    [
        ({"lengths": [0.6, 0.3]}, 0),
        ({"lengths": [0.4, 0.3]}, 1),  # a comparison comes out otherwise
        ({"lengths": [0.6, 0.7]}, 1),  # the reach is no longer cut off, and another comparison
        ({"lengths": [0.8, 0.2]}, 1),  # it is at its bound, to rounding
        ({"lengths": [0.7, 0.0]}, 1),
        ({"lengths": [0.7, -0.0]}, 1),
        ({"lengths": [math.nan, 0.1]}, 1),
        ({"lengths": [math.inf, 0.1]}, 1),
        ({"gain": 0.31}, 1),
        ({"order": 3}, 1),
        ({"dtype": torch.float32}, 1),
    ],
)
def test_what_decides_the_form_is_told_apart(counted: dict[str, int], change: dict[str, Any], again: int) -> None:
    first = {"lengths": [0.7, 0.2]}
    NativeFunction(Spring(**first), (X,))(X)
    module = Spring(**{**first, **change})
    for _ in range(2):  # and is known the second time
        torch.testing.assert_close(
            NativeFunction(module, (X,))(X),
            module(X),
            rtol=0,
            atol=1e-7 if "dtype" in change else 1e-15,
            equal_nan=True,
        )
        assert counted["traced"] == 1 + again
    # The first is still known.
    assert worst(NativeFunction(Spring(**first), (X,))(X), Spring(**first)(X)) < 1e-15
    assert counted["traced"] == 1 + again


def test_a_sum_that_is_one_to_rounding_is_no_form(counted: dict[str, int]) -> None:
    """Lengths that should add up to one miss it by a bit either way, and the program serves all of them."""
    sums = set()
    rng = random.Random(3)
    for _ in range(40):
        a = 0.55 + 0.4 * rng.random()
        module = Spring([a, 1.0 - a + rng.choice((-1, 0, 1)) * 2.0**-52])
        sums.add(float(module.lengths.sum() - 1.0))
        assert worst(NativeFunction(module, (X,))(X), module(X)) < 1e-15
    assert min(sums) < 0.0 < max(sums) and 0.0 in sums
    assert counted == {"traced": 1, "built": 1}


def test_one_tensor_held_twice_is_not_two() -> None:
    class Two(nn.Module):
        def __init__(self, a: Tensor, b: Tensor) -> None:
            super().__init__()
            self.a, self.b = a, b

        def forward(self, x: Tensor) -> Tensor:
            return (self.a - 0.5 * self.b) * x

    one = torch.tensor([1.3, 0.4], dtype=D)
    for module in (Two(one, one), Two(one, one.clone()), Two(one, 3.0 * one), Two(2.0 * one, one.clone())):
        assert worst(NativeFunction(module, (X,))(X), module(X)) < 1e-15


def test_what_is_changed_between_two_programs_is_seen() -> None:
    module = Spring([0.7, 0.2])
    step = NativeFunction(module, (X,))
    assert worst(step(X), module(X)) < 1e-15
    module.lengths.mul_(1.1)
    many = torch.stack((X, 0.5 * X))
    assert worst(step(many), torch.vmap(module)(many)) < 1e-15


def controller_and_step(arm: Arm, **gains: Any) -> tuple[APCCController, tuple[Any, ...]]:
    c, L0, q = APCCController.for_arm(arm, elongation_bound=0.08, **gains), arm.rest_lengths(), torch.zeros(9, dtype=D)
    T = arm.backbone().pose(q + 0.01, L0, *decouple(arm.sensor_places(), L0))
    target = Target(torch.tensor([0.2, 0.1, -0.5], dtype=D), torch.zeros(3, dtype=D))
    return c, (c.initial_state(q, 1.05 * L0), Measurement(T, torch.tensor(0.01, dtype=D)), target)


def test_each_tensor_of_the_controller_is_read(counted: dict[str, int]) -> None:
    """Another value of any of them: the compiled step follows, without a trace, as the eager one does."""
    c, given = controller_and_step(Arm(lengths=list(LENGTHS)))
    with torch.no_grad():
        NativeFunction(c, given).program(1)
        count = len(fingerprint(c).held)
        for k in range(count):
            other = copy.deepcopy(c)
            tensor = fingerprint(other).held[k]
            (name,) = {name.split(".")[-1] for name, each in other.named_buffers() if each is tensor}
            if name in PLACES:  # they move together, as in the test below: a sensor beyond the arm is another form
                continue
            tensor.mul_(1.0 + 0.01 * torch.rand(tensor.shape, dtype=D, generator=generator(k)))
            step = NativeFunction(other, given)
            assert worst(step(*given), other(*given)) < 1e-12, name
    assert counted == {"traced": 1, "built": 1} and count > 20


def plain_places(item: Any, met: set[int]) -> Iterator[tuple[Any, str]]:
    """Every plain number of a module and all it holds: (what has it, its name)."""
    if id(item) in met:
        return
    met.add(id(item))
    for name, value in list(vars(item).items()):
        if type(value) in (bool, int, float) and name != "training" and not name.startswith("_is_"):
            yield item, name
        elif isinstance(value, dict) and name == "_modules":
            for part in value.values():
                yield from plain_places(part, met)


def test_each_plain_number_of_the_controller_has_a_part_in_the_name() -> None:
    """They may be branched on, so they are told apart and not read."""
    c, _ = controller_and_step(Arm(lengths=list(LENGTHS)))
    names = {fingerprint(c).name}
    places = list(plain_places(c, set()))
    for item, name in places:
        value = vars(item)[name]
        vars(item)[name] = not value if isinstance(value, bool) else value + 1
        names.add(fingerprint(c).name)
        vars(item)[name] = value
    assert len(names) == len(places) + 1 > 50


def test_a_second_arm_needs_no_trace(counted: dict[str, int]) -> None:
    """Arms of other lengths, masses and gains, at the controller that ships."""
    first = {"mass": 0.4, "tendon_offset": 0.015}
    others = [
        ({}, {}),
        ({"lengths": [0.11, 0.2, 0.31]}, {}),
        ({"lengths": [0.1437, 0.2291, 0.2603], "mass": 0.35}, {"K": 1.3}),
        ({"tendon_offset": 0.02, "bending_stiffness": 0.9}, {"K": 2.5}),
    ]
    for changed, gains in others:
        arm = Arm(**{"lengths": list(LENGTHS), **first, **changed})
        c, given = controller_and_step(arm, **gains)
        with torch.no_grad():
            step = NativeFunction(c, given)
            assert worst(step(*given), c(*given)) < 1e-12
    assert counted == {"traced": 1, "built": 1}
