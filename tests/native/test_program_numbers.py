"""The numbers of a program from what a module holds: those of a trace, bit for bit, or none."""

from __future__ import annotations

import math
import random
from typing import Any

import torch

from apcc_torch.native.program_numbers import ProgramNumbers
from apcc_torch.native.scalars import FLOAT, Held, Scalars

D = torch.float64

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
