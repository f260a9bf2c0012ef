"""What is kept of a module serves others of its structure with their own numbers, and none of another structure."""

from __future__ import annotations

import copy
import ctypes
import importlib
import math
import random
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor, nn

from apcc_torch import APCCController, Arm, Measurement, Target, decouple
from apcc_torch.errors import CompileError
from apcc_torch.native import kept_program
from apcc_torch.native.fingerprint import fingerprint
from apcc_torch.native.function import NativeFunction
from apcc_torch.native.program_numbers import ProgramNumbers
from apcc_torch.native.scalars import FLOAT, Held, Scalars
from apcc_torch.native.structure import flattened
from apcc_torch.native.trace import traced
from laws import generator

D = torch.float64
LENGTHS = (0.105, 0.255, 0.24)
PLACES = ("abscissae", "anchors", "lengths", "nominal")


@pytest.fixture(autouse=True)
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv("APCC_CACHE", str(tmp_path / "cache"))
    return tmp_path / "cache"


@pytest.fixture
def counted(monkeypatch: pytest.MonkeyPatch) -> dict[str, int]:
    """How often something was traced and built."""
    counts = {"traced": 0, "built": 0}

    def counting(name: str, function: Callable[..., Any], *args: Any, **named: Any) -> Any:
        counts[name] += 1
        return function(*args, **named)

    monkeypatch.setattr("apcc_torch.native.function.traced", partial(counting, "traced", traced))
    monkeypatch.setattr(kept_program, "built", partial(counting, "built", kept_program.built))
    return counts


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


def worst(have: Any, want: Any) -> float:
    pairs = [(a.double(), b.double()) for a, b in zip(flattened(have), flattened(want), strict=True)]
    return max(float((a - b).abs().max() / b.abs().max().clamp(min=1.0)) for a, b in pairs if b.numel())


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


class Sees(nn.Module):
    """Reads what it holds in some way."""

    def __init__(self, how: Callable[[Tensor], Any], held: list[float]) -> None:
        super().__init__()
        self.register_buffer("held", torch.tensor(held, dtype=D))
        self.how = how

    def forward(self, x: Tensor) -> Tensor:
        return x * self.how(self.held)


def _kept(held: Tensor) -> Any:
    return held.data[0] * list(held)[1] + len(held) + held.dim() + held.detach().contiguous().sum()


def _forms(held: Tensor) -> Any:
    return torch.tensor([1.5, 0.25], dtype=held.dtype).sum() * held[held.shape[0] - 1]


def _listed(held: Tensor) -> Any:
    return held.tolist()[0]


def _branched(held: Tensor) -> Any:
    return 2.0 if held.tolist()[0] > 1.0 else 3.0


def _numpy(held: Tensor) -> Any:
    return float(held.numpy()[0])


def _array(held: Tensor) -> Any:
    return float(np.asarray(held)[0])


def _parameter(held: Tensor) -> Any:
    return nn.Parameter(held, requires_grad=False)[0]


def _made_anew(held: Tensor) -> Any:
    return torch.tensor(held.tolist(), dtype=D)[0]


def _printed(held: Tensor) -> Any:
    return len(repr(held))


def _pointer(held: Tensor) -> Any:
    return ctypes.c_double.from_address(held.data_ptr()).value


@pytest.mark.parametrize("how", [_kept, _forms])
def test_ways_to_what_is_held(how: Callable[[Tensor], Any], counted: dict[str, int]) -> None:
    for held in ([1.5, 2.0], [0.7, 2.25], [1.625, 2.5]):
        module = Sees(how, held)
        assert worst(NativeFunction(module, (X,))(X), module(X)) < 1e-15
    assert counted == {"traced": 1, "built": 1}


@pytest.mark.parametrize("how", [_listed, _branched, _numpy, _array, _parameter, _made_anew, _printed, _pointer])
def test_values_that_are_read_past_torch_are_refused(how: Callable[[Tensor], Any]) -> None:
    with pytest.raises(CompileError, match=r"it asks for the value of a tensor|it makes a tensor of one that it holds"):
        NativeFunction(Sees(how, [1.5, 2.0]), (X,)).program(1)


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


NUMBERS = {
    "add": 2,
    "sub": 2,
    "mul": 2,
    "div": 2,
    "neg": 1,
    "abs": 1,
    "sqrt": 1,
    "sin": 1,
    "max": 2,
    "min": 2,
    "floor": 1,
}
TRUTHS = ("lt", "le", "eq", "ne")


def written(choices: list[Any], values: list[float]) -> tuple[Scalars, list[int]]:
    """The same random program on other held numbers, as a trace writes it."""
    scalars = Scalars()
    at = [scalars.held(value, f"1.{k}", Held(0, k)) for k, value in enumerate(values)]
    at += [scalars.constant(value, FLOAT) for value in (0.0, 1.0, -2.5)]
    at += [scalars.input(k, FLOAT) for k in range(2)]
    for op, *which in choices:
        if op == "select":
            condition = scalars.make(which[0], at[which[1]], at[which[2]])
            at.append(scalars.make("select", condition, at[which[3]], at[which[4]]))
        elif op == "int":
            at.append(scalars.make("float", scalars.make("int", at[which[0]])))
        else:
            at.append(scalars.make(op, *(at[k] for k in which)))
    return scalars, at


def random_program(rng: random.Random, held: int) -> list[Any]:
    count, choices = held + 5, []
    for _ in range(25):
        kind = rng.random()
        if kind < 0.15:
            choices.append(["select", rng.choice(TRUTHS), *(rng.randrange(count) for _ in range(4))])
        elif kind < 0.2:
            choices.append(["int", rng.randrange(count)])
        else:
            op = rng.choice(sorted(NUMBERS))
            choices.append([op, *(rng.randrange(count) for _ in range(NUMBERS[op]))])
        count += 1
    return choices


def form(scalars: Scalars) -> str:
    """The expressions without the numbers that are held."""
    return repr([(*e[:3], e.value if e.op in ("constant", "input") else e.value is None) for e in scalars.expressions])


def test_numbers_are_those_of_a_trace_or_none() -> None:
    """On random programs: where numbers are given, tracing anew gives the same form and numbers, bit for bit."""
    rng = random.Random(11)
    values = (0.0, -0.0, 1.0, -2.5, 0.5, 0.3, 1e-320, 1e300, math.inf, -math.inf, math.nan)
    fits = misses = 0
    for _ in range(400):
        choices = random_program(rng, 4)
        of_first = [rng.choice((rng.uniform(-2.0, 2.0), rng.choice(values))) for _ in range(4)]
        first, at = written(choices, of_first)
        asked = [k for k in at if first.known(k) is not None and first[k].kind == FLOAT]
        numbers = ProgramNumbers.of(first, asked)
        for _ in range(6):
            others = [rng.choice((v, v * (1.0 + 1e-12), rng.uniform(-2.0, 2.0), rng.choice(values))) for v in of_first]
            # As the name of a module tells: the same zeros.
            others = [v if v == 0.0 else (o if o != 0.0 else v) for v, o in zip(of_first, others, strict=True)]
            second, at_second = written(choices, others)
            found = numbers.values([torch.tensor(others, dtype=D)])
            if found is not None:
                assert at == at_second and form(first) == form(second)
                assert repr(found) == repr([second.number(k) for k in asked])
                fits += 1
            else:
                misses += 1
    assert fits > 300 and misses > 300


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


SESSION = """
from torch import nn

class Made(nn.Module):
    def forward(self, x):
        return {factor} * x
"""


@pytest.mark.parametrize("named", [{}, {"__name__": "a_session"}])
def test_what_a_session_made_is_traced_each_time(named: dict[str, str], folder: Path) -> None:
    for factor in (1.3, 1.7):
        session: dict[str, Any] = dict(named)
        exec(SESSION.format(factor=factor), session)
        for _ in range(2):
            assert torch.equal(NativeFunction(session["Made"](), (X,))(X), factor * X)
    assert not list(folder.glob("*.json")) and len(list(folder.glob("*.so"))) == 1


MINE = """
import torch
from torch import nn
import their_{n}
from their_{n} import helped

FACTOR = 1.3
WEIGHTS = torch.tensor([0.7, 0.9]).double()

class Base(nn.Module):
    share = 0.5

class Made(Base):
    def forward(self, x):
        return helped(x) + FACTOR * WEIGHTS * x + self.share + their_{n}.inner(x)
"""
THEIR = """
def helped(x):
    return {slope} * x

def inner(x):
    return x.sin()
"""


def test_code_from_elsewhere_counts_whole(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, counted: dict[str, int]
) -> None:
    """A helper in another file, a global, a tensor beside the class: each is told apart."""
    monkeypatch.syspath_prepend(tmp_path)
    made = []
    for n, slope in enumerate((0.25, 0.75)):
        (tmp_path / f"their_{n}.py").write_text(THEIR.format(slope=slope))
        (tmp_path / f"mine_{n}.py").write_text(MINE.format(n=n))
        made.append(importlib.import_module(f"mine_{n}"))
    mine = made[0]

    def right() -> None:
        module = mine.Made()
        assert worst(NativeFunction(module, (X,))(X), module(X)) < 1e-15

    right()
    (tmp_path / "their_0.py").write_text(THEIR.format(slope=0.75))
    monkeypatch.setattr(mine, "helped", made[1].helped)
    right()
    monkeypatch.setattr(mine, "FACTOR", 1.4)
    right()
    assert counted["traced"] == 3
    monkeypatch.setattr(mine, "WEIGHTS", torch.tensor([0.6, 0.8]).double())
    right()
    assert counted["traced"] == 3  # of a tensor the numbers are read


def scaled_by(factor: Any) -> Callable[[Tensor], Tensor]:
    def scaled(x: Tensor, more: float = 1.0) -> Tensor:
        return factor * more * x

    return scaled


class Calls(nn.Module):
    def __init__(self, function: Callable[[Tensor], Tensor]) -> None:
        super().__init__()
        self.function = function

    def forward(self, x: Tensor) -> Tensor:
        return self.function(x)


class Scales:
    def __init__(self, factor: float) -> None:
        self.factor = factor

    def of(self, x: Tensor) -> Tensor:
        return self.factor * x


def test_functions_count_with_what_they_hold() -> None:
    for factor in (1.3, 1.7, torch.tensor([1.2, 1.9], dtype=D), torch.tensor([1.4, 1.8], dtype=D)):
        ways = [scaled_by(factor), partial(torch.mul, factor), partial(scaled_by(1.1), more=factor)]
        ways += [Scales(factor).of] if isinstance(factor, float) else []
        for way in ways:
            module = Calls(way)
            assert worst(NativeFunction(module, (X,))(X), module(X)) < 1e-15


class Describes(nn.Module):
    """Holds a description, of which it reads some or nothing."""

    def __init__(self, arm: Arm, how: Callable[[Arm], float]) -> None:
        super().__init__()
        self.arm, self.again, self.how = arm, [arm], how

    def forward(self, x: Tensor) -> Tensor:
        return self.how(self.again[0]) * x


def _nothing(arm: Arm) -> float:
    return 1.3 if isinstance(arm, Arm) else 1.7


def _field(arm: Arm) -> float:
    return float(arm.mass)  # type: ignore[arg-type]


def _whole(arm: Arm) -> float:
    return 1.3 if arm == Arm(lengths=[0.2], mass=0.4) else 1.7


def _members(arm: Arm) -> float:
    return float(vars(arm)["lengths"][0])


@pytest.mark.parametrize(("how", "again"), [(_nothing, 0), (_field, 2), (_whole, 2), (_members, 2)])
def test_settings_count_where_they_are_read(how: Callable[[Arm], float], again: int, counted: dict[str, int]) -> None:
    for _ in range(2):
        for arm in (Arm(lengths=[0.2], mass=0.4), Arm(lengths=[0.25], mass=0.4), Arm(lengths=[0.2], mass=0.5)):
            module = Describes(arm, how)
            assert worst(NativeFunction(module, (X,))(X), module(X)) < 1e-15
    assert counted["traced"] == 1 + again
