"""The transposed program of a trace: what a gradient by its results comes to by its arguments."""

from __future__ import annotations

from collections.abc import Callable

import torch

from apcc_torch.errors import CompileError
from apcc_torch.native.scalars import FLOAT, Scalars
from apcc_torch.native.trace import Leaf, Trace

Rule = Callable[[Scalars, int, int, tuple[int, ...]], tuple[int | None, ...]]
"""(scalars, gradient by the result, the result, its operands) -> gradients by the operands, None for none."""


def transposed(trace: Trace) -> Trace:
    """The function of the arguments, and of gradients by the floating-point results, to gradients by such arguments.

    Reverse accumulation, expression by expression. What is known has no gradient, nor have integers and truth values.
    Where two values are equally large the first one's gradient is taken, and a root of zero has none.

    Args:
        trace: Of a function that repeats nothing on its own result.

    Raises:
        CompileError: It does.
    """
    scalars = trace.scalars
    if scalars.loops:
        raise CompileError("what is repeated on its own result has no gradient in machine code: run it eagerly")
    count, results = len(scalars.expressions), [leaf for leaf in trace.outputs if leaf.dtype.is_floating_point]
    gradients: dict[int, int] = {}

    def add(index: int, gradient: int) -> None:
        if scalars.known(index) is None and scalars[index].kind == FLOAT:
            before = gradients.get(index)
            gradients[index] = gradient if before is None else scalars.make("add", before, gradient)

    number = sum(_size(leaf) for leaf in trace.inputs)
    for leaf, row in zip(trace.outputs, trace.results, strict=True):
        if leaf.dtype.is_floating_point:
            for index in row:
                add(index, scalars.input(number, FLOAT))
                number += 1
    for index in reversed(range(count)):
        expression, gradient = scalars[index], gradients.get(index)
        if gradient is not None and expression.operands:
            found = _RULES[expression.op](scalars, gradient, index, expression.operands)
            for operand, share in zip(expression.operands, found, strict=True):
                if share is not None:
                    add(operand, share)
    zero = scalars.constant(0.0, FLOAT)
    asked = [leaf for leaf in trace.inputs if leaf.dtype.is_floating_point]
    flat = iter([gradients.get(scalars.input(k, FLOAT), zero) for k in range(sum(map(_size, asked)))])
    rows = [[next(flat) for _ in range(_size(leaf))] for leaf in asked]
    return Trace(scalars, [*trace.inputs, *results], asked, rows, trace.calls, trace.read)


def _size(leaf: Leaf) -> int:
    """How many floating-point numbers it has."""
    return int(torch.Size(leaf.shape).numel()) if leaf.dtype.is_floating_point else 0


def _one(s: Scalars) -> int:
    return s.constant(1.0, FLOAT)


def _zero(s: Scalars) -> int:
    return s.constant(0.0, FLOAT)


def _where(s: Scalars, condition: int, gradient: int) -> int:
    return s.make("select", condition, gradient, _zero(s))


def _divided(s: Scalars, g: int, result: int, x: tuple[int, ...]) -> tuple[int, ...]:
    share = s.make("div", g, x[1])
    return share, s.make("neg", s.make("mul", share, result))


def _powered(s: Scalars, g: int, result: int, x: tuple[int, ...]) -> tuple[int | None, ...]:
    less = s.make("pow", x[0], s.make("sub", x[1], _one(s)))
    by_exponent = None if s.known(x[1]) is not None else s.make("mul", g, s.make("mul", result, s.make("log", x[0])))
    return s.make("mul", g, s.make("mul", x[1], less)), by_exponent


def _sized(s: Scalars, g: int, result: int, x: tuple[int, ...]) -> tuple[int, ...]:
    below, above = s.make("lt", x[0], _zero(s)), s.make("lt", _zero(s), x[0])
    return (s.make("sub", _where(s, above, g), _where(s, below, g)),)


def _root(s: Scalars, g: int, result: int, x: tuple[int, ...]) -> tuple[int, ...]:
    share = s.make("div", s.make("mul", s.constant(0.5, FLOAT), g), result)
    return (_where(s, s.make("ne", result, _zero(s)), share),)


def _turned(s: Scalars, g: int, result: int, x: tuple[int, ...]) -> tuple[int, ...]:
    square = s.make("add", s.make("mul", x[0], x[0]), s.make("mul", x[1], x[1]))
    share = s.make("div", g, square)
    return s.make("mul", share, x[1]), s.make("neg", s.make("mul", share, x[0]))


def _larger(s: Scalars, g: int, result: int, x: tuple[int, ...]) -> tuple[int, ...]:
    other = s.make("lt", x[0], x[1])
    return _where(s, s.make("not", other), g), _where(s, other, g)


def _smaller(s: Scalars, g: int, result: int, x: tuple[int, ...]) -> tuple[int, ...]:
    other = s.make("lt", x[1], x[0])
    return _where(s, s.make("not", other), g), _where(s, other, g)


def _chosen(s: Scalars, g: int, result: int, x: tuple[int, ...]) -> tuple[int | None, ...]:
    return None, _where(s, x[0], g), _where(s, s.make("not", x[0]), g)


def _sloped(slope: Callable[[Scalars, int, int], int]) -> Rule:
    """Of a function of one number: gradient times `slope` of (scalars, result, operand)."""
    return lambda s, g, result, x: (s.make("mul", g, slope(s, result, x[0])),)


def _circle(s: Scalars, x: int) -> int:
    """1 / sqrt(1 - x^2)."""
    return s.make("div", _one(s), s.make("sqrt", s.make("sub", _one(s), s.make("mul", x, x))))


def _nothing(s: Scalars, g: int, result: int, x: tuple[int, ...]) -> tuple[None, ...]:
    return (None,) * len(x)


_RULES: dict[str, Rule] = {
    "add": lambda s, g, result, x: (g, g),
    "sub": lambda s, g, result, x: (g, s.make("neg", g)),
    "mul": lambda s, g, result, x: (s.make("mul", g, x[1]), s.make("mul", g, x[0])),
    "div": _divided,
    "pow": _powered,
    "neg": lambda s, g, result, x: (s.make("neg", g),),
    "abs": _sized,
    "sqrt": _root,
    "max": _larger,
    "min": _smaller,
    "select": _chosen,
    "sin": _sloped(lambda s, result, x: s.make("cos", x)),
    "cos": _sloped(lambda s, result, x: s.make("neg", s.make("sin", x))),
    "tan": _sloped(lambda s, result, x: s.make("add", _one(s), s.make("mul", result, result))),
    "tanh": _sloped(lambda s, result, x: s.make("sub", _one(s), s.make("mul", result, result))),
    "exp": _sloped(lambda s, result, x: result),
    "expm1": _sloped(lambda s, result, x: s.make("add", result, _one(s))),
    "log": _sloped(lambda s, result, x: s.make("div", _one(s), x)),
    "asin": _sloped(lambda s, result, x: _circle(s, x)),
    "acos": _sloped(lambda s, result, x: s.make("neg", _circle(s, x))),
    "atan": _sloped(lambda s, result, x: s.make("div", _one(s), s.make("add", _one(s), s.make("mul", x, x)))),
    "atan2": _turned,
    "floor": _nothing,
    "float": _nothing,
}
