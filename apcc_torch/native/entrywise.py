"""Tensor operations that work entry by entry."""

from __future__ import annotations

import torch

from apcc_torch.native.scalars import BOOL, FLOAT, INT
from apcc_torch.native.values import Arithmetic, Operand, Operator, Value, kind_of, mapped


def _kind(*operands: Operand) -> str:
    """The kind that torch's promotion gives."""
    kinds = {kind_of(o.dtype) if isinstance(o, Value) else _kind_of_number(o) for o in operands}
    return FLOAT if FLOAT in kinds else INT if INT in kinds else BOOL


def _kind_of_number(value: float | int | bool) -> str:
    return BOOL if isinstance(value, bool) else INT if isinstance(value, int) else FLOAT


def entrywise(op: str, kind: str | None = None) -> Operator:
    def run(a: Arithmetic, dtype: torch.dtype, *operands: Operand) -> Value:
        return a.entrywise(lambda *x: a.scalars.make(op, *x), list(operands), kind or _kind(*operands), dtype)

    return run


def swapped(op: str) -> Operator:
    def run(a: Arithmetic, dtype: torch.dtype, x: Operand, y: Operand) -> Value:
        return a.entrywise(lambda p, q: a.scalars.make(op, q, p), [x, y], _kind(x, y), dtype)

    return run


def logic(op: str) -> Operator:
    """Of truth values the logical operation; integers have none here."""
    return entrywise(op, BOOL)


def scaled(op: str) -> Operator:
    """x + alpha y and x - alpha y."""

    def run(a: Arithmetic, dtype: torch.dtype, x: Operand, y: Operand, alpha: float = 1) -> Value:
        make, kind = a.scalars.make, kind_of(dtype)
        factor = a.scalars.constant(alpha, kind)
        return a.entrywise(lambda p, q: make(op, p, make("mul", factor, q)), [x, y], kind, dtype)

    return run


def lerp(a: Arithmetic, dtype: torch.dtype, x: Operand, y: Operand, weight: Operand) -> Value:
    """x + w (y - x), from the nearer end as torch has it."""
    make, one, half = a.scalars.make, a.scalars.constant(1.0, FLOAT), a.scalars.constant(0.5, FLOAT)

    def between(p: int, q: int, w: int) -> int:
        step = make("sub", q, p)
        near = make("add", p, make("mul", w, step))
        far = make("sub", q, make("mul", step, make("sub", one, w)))
        return make("select", make("lt", make("abs", w), half), near, far)

    return a.entrywise(between, [x, y, weight], FLOAT, dtype)


def rsub(a: Arithmetic, dtype: torch.dtype, x: Operand, y: Operand, alpha: float = 1) -> Value:
    return scaled("sub")(a, dtype, y, x, alpha)


def addcmul(a: Arithmetic, dtype: torch.dtype, x: Operand, y: Operand, z: Operand, value: float = 1) -> Value:
    make, factor = a.scalars.make, a.scalars.constant(value, FLOAT)
    return a.entrywise(lambda p, q, r: make("add", p, make("mul", make("mul", factor, q), r)), [x, y, z], FLOAT, dtype)


def reciprocal(a: Arithmetic, dtype: torch.dtype, x: Operand) -> Value:
    return entrywise("div", FLOAT)(a, dtype, 1.0, x)


def square(a: Arithmetic, dtype: torch.dtype, x: Operand) -> Value:
    return a.entrywise(lambda p: a.scalars.make("mul", p, p), [x], kind_of(dtype), dtype)


def power(a: Arithmetic, dtype: torch.dtype, x: Operand, exponent: Operand) -> Value:
    make = a.scalars.make
    if isinstance(exponent, Value):
        return a.entrywise(lambda p, q: make("pow", p, q), [x, exponent], FLOAT, dtype)
    if exponent == 0.5:
        return entrywise("sqrt", FLOAT)(a, dtype, x)
    if exponent == int(exponent) and 1 <= exponent <= 8:
        return a.entrywise(lambda p: a.folded("mul", [p] * int(exponent)), [x], kind_of(dtype), dtype)
    power = a.scalars.constant(exponent, FLOAT)
    return a.entrywise(lambda p: make("pow", p, power), [x], FLOAT, dtype)


def clamp(
    a: Arithmetic, dtype: torch.dtype, x: Operand, min: Operand | None = None, max: Operand | None = None
) -> Value:
    kind = kind_of(dtype)
    result = Value(a.entries(x, kind), dtype)
    for bound, op in ((min, "max"), (max, "min")):
        if bound is not None:
            result = a.entrywise(lambda p, q, op=op: a.scalars.make(op, p, q), [result, bound], kind, dtype)
    return result


def threshold(a: Arithmetic, dtype: torch.dtype, x: Operand, threshold: float, value: float) -> Value:
    make = a.scalars.make
    low, other = a.scalars.constant(threshold, FLOAT), a.scalars.constant(value, FLOAT)
    # What is not a number stays what it is.
    return a.entrywise(lambda p: make("select", make("le", p, low), other, p), [x], FLOAT, dtype)


def where(a: Arithmetic, dtype: torch.dtype, condition: Value, x: Operand, y: Operand) -> Value:
    kind = kind_of(dtype)
    parts = (a.entries(condition, BOOL), a.entries(x, kind), a.entries(y, kind))
    return Value(mapped(lambda c, p, q: a.scalars.make("select", c, p, q), *parts), dtype)


def masked_fill(a: Arithmetic, dtype: torch.dtype, x: Operand, mask: Value, value: Operand) -> Value:
    return where(a, dtype, mask, value, x)


def converted(a: Arithmetic, dtype: torch.dtype, x: Operand, *_: object, **__: object) -> Value:
    # A copy: what is written into the result must not be written into what it was made from.
    return Value(a.entries(x, kind_of(dtype)).clone(), dtype)
