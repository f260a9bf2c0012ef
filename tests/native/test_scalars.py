"""Simplification never changes a value: random expressions, simplified and as they are written."""

from __future__ import annotations

import math

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from apcc_torch.native.scalars import BOOL, FLOAT, INT, Scalars

BINARY = {"add": lambda a, b: a + b, "sub": lambda a, b: a - b, "mul": lambda a, b: a * b}
Tree = tuple[object, ...]

leaves = st.one_of(
    st.sampled_from([0.0, 1.0, -1.0, 2.0, -0.5]).map(lambda v: ("constant", v)),
    st.integers(0, 2).map(lambda n: ("input", n)),
)
trees = st.recursive(
    leaves,
    lambda inner: st.one_of(
        st.tuples(st.sampled_from(sorted(BINARY)), inner, inner),
        st.tuples(st.just("neg"), inner),
        st.tuples(st.just("select"), inner, inner, inner),
    ),
    max_leaves=12,
)


def built(scalars: Scalars, tree: Tree) -> int:
    if tree[0] == "constant":
        return scalars.constant(tree[1], FLOAT)
    if tree[0] == "input":
        return scalars.input(tree[1], FLOAT)
    parts = [built(scalars, part) for part in tree[1:]]
    if tree[0] == "select":
        parts[0] = scalars.make("lt", scalars.constant(0.0, FLOAT), parts[0])
    return scalars.make(tree[0], *parts)


def plain(tree: Tree, inputs: list[float]) -> float:
    if tree[0] == "constant":
        return tree[1]
    if tree[0] == "input":
        return inputs[tree[1]]
    parts = [plain(part, inputs) for part in tree[1:]]
    if tree[0] == "neg":
        return -parts[0]
    return (parts[1] if parts[0] > 0.0 else parts[2]) if tree[0] == "select" else BINARY[tree[0]](*parts)


def value(scalars: Scalars, index: int, inputs: list[float]) -> float | bool:
    expression = scalars[index]
    if expression.op == "constant":
        return expression.value
    if expression.op == "input":
        return inputs[expression.value]
    parts = [value(scalars, i, inputs) for i in expression.operands]
    if expression.op == "neg":
        return -parts[0]
    if expression.op == "lt":
        return parts[0] < parts[1]
    return (parts[1] if parts[0] else parts[2]) if expression.op == "select" else BINARY[expression.op](*parts)


@given(tree=trees, inputs=st.lists(st.integers(-8, 8).map(float), min_size=3, max_size=3))
@settings(deadline=None, max_examples=300)
def test_simplified_is_equal(tree: Tree, inputs: list[float]) -> None:
    scalars = Scalars()
    # Small integers and halves: sums and products are exact, so any order of them is.
    assert value(scalars, built(scalars, tree), inputs) == plain(tree, inputs)


def test_equal_expressions_are_one() -> None:
    scalars = Scalars()
    x, y = scalars.input(0, FLOAT), scalars.input(1, FLOAT)
    assert scalars.make("add", x, y) == scalars.make("add", y, x)
    assert scalars.make("sub", x, y) != scalars.make("sub", y, x)
    assert scalars.constant(0.0, FLOAT) != scalars.constant(-0.0, FLOAT) != scalars.constant(0, INT)


@pytest.mark.parametrize(
    ("op", "operands", "want"),
    [("div", (1.0, 0.0), math.inf), ("div", (-1.0, 0.0), -math.inf), ("sqrt", (4.0,), 2.0), ("floor", (-0.5,), -1.0)],
)
def test_constants_are_folded(op: str, operands: tuple[float, ...], want: float) -> None:
    scalars = Scalars()
    found = scalars.make(op, *(scalars.constant(v, FLOAT) for v in operands))
    assert scalars.known(found) == want


def test_what_is_not_a_number_stays_so() -> None:
    scalars = Scalars()
    zero = scalars.constant(0.0, FLOAT)
    for found in (scalars.make("div", zero, zero), scalars.make("sqrt", scalars.constant(-1.0, FLOAT))):
        assert math.isnan(scalars.known(found))


def test_truth() -> None:
    scalars = Scalars()
    p, yes, no = scalars.input(0, BOOL), scalars.constant(True, BOOL), scalars.constant(False, BOOL)
    assert scalars.make("and", p, yes) == p == scalars.make("or", no, p) == scalars.make("not", scalars.make("not", p))
    assert scalars.make("and", no, p) == no and scalars.make("or", p, yes) == yes
    x, y = scalars.input(1, FLOAT), scalars.input(2, FLOAT)
    assert scalars.make("select", scalars.make("not", p), x, y) == scalars.make("select", p, y, x)


@pytest.mark.parametrize("op", ["max", "min"])
def test_what_is_not_a_number_stays_so_when_it_is_folded(op: str) -> None:
    scalars = Scalars()
    nan, one = scalars.constant(math.nan, FLOAT), scalars.constant(1.0, FLOAT)
    for pair in ((nan, one), (one, nan)):
        assert math.isnan(float(scalars.known(scalars.make(op, *pair)) or 0.0))
