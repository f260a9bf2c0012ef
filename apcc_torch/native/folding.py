"""Operations on numbers that are known before the machine computes."""

from __future__ import annotations

import math
import operator
from collections.abc import Callable, Sequence
from typing import Any

Constant = float | int | bool


def _divided(a: float, b: float) -> float:
    if b != 0.0:
        return a / b
    return math.nan if a == 0.0 or math.isnan(a) else math.copysign(math.inf, a) * math.copysign(1.0, b)


def _root(a: float) -> float:
    return math.sqrt(a) if a >= 0.0 else math.nan


FOLDED: dict[str, Callable[..., Constant]] = {
    "add": operator.add,
    "sub": operator.sub,
    "mul": operator.mul,
    "div": _divided,
    "neg": operator.neg,
    "abs": abs,
    "sqrt": _root,
    "sin": math.sin,
    "cos": math.cos,
    "floor": math.floor,
    # As lanes.hpp has them: what is not a number stays so.
    "max": lambda a, b: b if b > a or b != b else a,
    "min": lambda a, b: b if b < a or b != b else a,
    "lt": operator.lt,
    "le": operator.le,
    "eq": operator.eq,
    "ne": operator.ne,
    "and": lambda a, b: a and b,
    "or": lambda a, b: a or b,
    "not": operator.not_,
    "float": float,
    "int": int,
    "isfinite": math.isfinite,
}
"""Operations that are done here where their operands are known; the others always stay operations."""


def folded(op: str, values: Sequence[Any], loose: Sequence[float]) -> tuple[Constant | None, float]:
    """What an operation of `FOLDED` on known numbers comes to, and by how much it may be off as they may be by `loose`.

    None where Python has no such number: the sine of infinity and NaN as an integer are left to the machine.
    """
    try:
        result = FOLDED[op](*values)
    except (OverflowError, ValueError):
        return None, 0.0
    return result, _looseness(op, values, result, loose) if any(loose) else 0.0


LOOSE = 1e-9
"""Part of a held number by which another arm's may miss the same relation, as two lengths that should add up to one."""


def _looseness(op: str, values: Sequence[Any], result: Constant, given: Sequence[float]) -> float:
    a, b = values[0], values[-1]
    if op in ("max", "min") and abs(a - b) > sum(given):
        return given[0] if result == a else given[1]
    if op == "mul":
        return abs(a) * given[1] + abs(b) * given[0] + given[0] * given[1]
    if op == "div":
        return math.inf if abs(b) <= given[1] else (given[0] + abs(result) * given[1]) / (abs(b) - given[1])
    if op == "sqrt":
        return math.sqrt(given[0])
    if op == "floor" and math.isfinite(given[0]):
        return float(math.floor(a - given[0]) != math.floor(a + given[0]))
    return sum(given)  # sums and differences; of the others no slope is steeper
