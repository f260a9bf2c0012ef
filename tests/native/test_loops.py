"""Loops that tracing has unrolled are found and written once, and compute the same bits."""

from __future__ import annotations

from collections.abc import Callable

import pytest
import torch
from torch import Tensor

from apcc_torch.native.layout import laid_out
from apcc_torch.native.loops import LEAST, Loop, rolled
from apcc_torch.native.scalars import Expression, Scalars
from apcc_torch.native.trace import Trace, traced
from laws import generator, normal

D = torch.float64
ROUNDS = 6


def value(expressions: list[Expression], index: int, known: dict[int, float], given: list[float]) -> float:
    """What an expression comes to, by an evaluator of its own."""
    if index not in known:
        e = expressions[index]
        if e.op == "input":
            known[index] = given[int(e.value or 0)]
        elif e.value is not None:
            known[index] = float(e.value)
        else:
            a = [value(expressions, i, known, given) for i in e.operands]
            known[index] = {
                "add": lambda: a[0] + a[1],
                "sub": lambda: a[0] - a[1],
                "mul": lambda: a[0] * a[1],
                "div": lambda: a[0] / a[1],
                "neg": lambda: -a[0],
                "sqrt": lambda: a[0] ** 0.5,
                "lt": lambda: float(a[0] < a[1]),
                "select": lambda: a[1] if a[0] else a[2],
            }[e.op]()
    return known[index]


def run(trace: Trace, loops: bool, given: list[float]) -> list[float]:
    """The results of a trace whose statements are run in the order of its layout."""
    layout = laid_out(trace, loops)
    known: dict[int, float] = {}
    expressions = layout.expressions

    def once(parts: range) -> None:
        for k in parts:
            for index in layout.parts[k]:
                known.pop(index, None)
                for operand in expressions[index].operands:
                    assert operand in known or expressions[operand].value is not None, "it is read before it is made"
                value(expressions, index, known, given)

    done = 0
    for loop in layout.loops:
        once(range(done, loop.first))
        for each in loop.handed:
            known[each.carried] = value(expressions, each.first, known, given)
        for _ in range(loop.rounds):
            once(range(loop.first, loop.last + 1))
            handed = {each.carried: known[each.next] for each in loop.handed}
            known.update(handed)
        done = loop.last + 1
    once(range(done, len(layout.parts)))
    return [value(expressions, index, known, given) for row in layout.results for index in row]


def newton(x: Tensor, b: Tensor) -> Tensor:
    """Rounds that are frozen row by row, with a first round and a tail of their own."""
    damping = torch.ones_like(x[..., :1])
    best = x
    for _ in range(ROUNDS):
        A = b.unsqueeze(-1) * b.unsqueeze(-2) + torch.eye(b.shape[-1], dtype=b.dtype) * (1.0 + damping.unsqueeze(-1))
        trial = best - 0.1 * (A @ (best * best - b).unsqueeze(-1)).squeeze(-1)
        better = (trial * trial).sum(-1, keepdim=True) < (best * best).sum(-1, keepdim=True)
        best = torch.where(better, trial, best)
        damping = torch.where(better, 0.1 * damping, 10.0 * damping)
    return (best * damping).sum(-1) / b.sum(-1)


def lagging(x: Tensor, b: Tensor) -> Tensor:
    """Rounds that read two rounds back: of every two of them a loop can be made."""
    older, old = x, x * b
    for _ in range(ROUNDS):
        older, old = old, (old.unsqueeze(-1) * older.unsqueeze(-2)).cumsum(-1).sum(-1) - b
    return old


def telling(x: Tensor, b: Tensor) -> Tensor:
    """Rounds of which each is told afterwards: they are no loop."""
    told = []
    for _ in range(ROUNDS):
        x = (x.unsqueeze(-1) * x.unsqueeze(-2)).cumsum(-1).sum(-1) - b
        told.append(x.sum(-1))
    return torch.stack(told, -1)


@pytest.mark.parametrize(("function", "found"), [(newton, True), (lagging, None), (telling, False)])
def test_rolled_or_not_it_computes_the_same(function: Callable[..., Tensor], found: bool | None) -> None:
    rng = generator(2)
    x, b = 0.3 * normal((9,), D, rng), 1.0 + normal((9,), D, rng).abs()
    trace = traced(function, (x, b))
    made = rolled(trace.scalars.expressions, trace.results)
    loops = [segment for segment in made.segments if isinstance(segment, Loop)]
    assert found is None or bool(loops) == found
    if found:
        (loop,) = loops
        assert loop.rounds >= ROUNDS - 2 and len(loop.statements) * (loop.rounds - 1) >= LEAST
    given = [*x.tolist(), *b.tolist()]
    assert run(trace, True, given) == run(trace, False, given)
    torch.testing.assert_close(
        torch.tensor(run(trace, True, given), dtype=D), function(x, b).reshape(-1), rtol=1e-12, atol=1e-12
    )


def test_what_has_no_loop_stays_as_it_is() -> None:
    scalars = Scalars()
    a = scalars.input(0, "f")
    b = scalars.make("mul", a, a)
    made = rolled(scalars.expressions, [[b]])
    assert made.segments == [[b]] and made.expressions == scalars.expressions
