"""Scalar expressions, each stored once: what a traced function is written out to.

An expression is an index into one list. Equal expressions share an index, constants are folded and neutral elements
dropped as expressions are made, so what a tensor of zeros multiplies costs nothing. In one point the arithmetic is not
IEEE's: zero times anything is zero, and what is not finite does not spread through a product with a constant zero.

What a function holds is known as well, and so is what follows from it alone. But only its zeros shape the
expressions; other values stay apart by where they come from, so functions that differ in these alone look alike. A
difference that is zero to rounding is no zero: in the next arm it may not be.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import NamedTuple

from apcc_torch.native.folding import FOLDED, LOOSE, Constant, folded

# Kinds of expression: a floating-point number, an integer, a truth value.
FLOAT, INT, BOOL = "f", "i", "b"


class Expression(NamedTuple):
    """One operation on other expressions.

    op: Name of the operation; "constant", "held", "input", "variable", "outcome" and "returned" have no operands.
    operands: Indices of the operands.
    kind: FLOAT, INT or BOOL.
    value: What it comes to, where that is known now; of an input its number among those of its kind.
    """

    op: str
    operands: tuple[int, ...]
    kind: str
    value: Constant | None = None


class Held(NamedTuple):
    """An entry of one of the tensors that a function is known to hold, by their numbers."""

    tensor: int
    entry: int


class Entry(NamedTuple):
    """A scalar of a loop's state."""

    loop: int
    place: int


class Returned(NamedTuple):
    """A scalar that a call of a routine came to: the routine, the number of the call, and the place in the state."""

    routine: int
    call: int
    place: int


@dataclass
class Loop:
    """Expressions that are computed again and again, on what they came to the time before.

    parent: The loop in which it runs, None for none. times: Most rounds.
    variables, initial, results, outcomes: Of each scalar of its state the expression that stands for it within the
        loop, the one it begins with, the one it goes on with, and the one that stands for it afterwards.
    going: Place in the state of the truth value that asks for another round; None of a routine.
    calls: Of a routine, which is run at several places, the expressions that each call hands in. Its state is what is
        handed in and then what it comes to, which is read after each call; it has neither `initial` nor `outcomes`.
    """

    parent: int | None
    times: int
    variables: list[int] = field(default_factory=list)
    initial: list[int] = field(default_factory=list)
    results: list[int] = field(default_factory=list)
    outcomes: list[int] = field(default_factory=list)
    going: int | None = None
    calls: list[list[int]] = field(default_factory=list)

    def begun(self, call: int | None) -> list[int]:
        """What a run of it begins with: a routine's call of this number, None for a loop."""
        return self.initial if call is None else self.calls[call]


COMMUTATIVE = frozenset({"add", "mul", "eq", "ne", "and", "or"})
_TRUTH = frozenset({"lt", "le", "eq", "ne", "and", "or", "not", "isfinite"})


class Scalars:
    """A growing list of expressions, the operands of each before it."""

    def __init__(self) -> None:
        self.expressions: list[Expression] = []
        self.loops: list[Loop] = []
        self.entry_of: dict[int, Entry] = {}
        self.returned_of: dict[int, Returned] = {}
        self.held_at: dict[int, Held] = {}
        self.decided: dict[tuple[str, tuple[int, ...]], Constant | None] = {}
        """What the form of the expressions was decided by: operations on held numbers that came to a constant, and to
        None where they had to be left to the machine."""
        self.loose: dict[int, float] = {}
        """By how much known numbers may be off in another arm of the same form; those that are not here, by nothing."""
        self._known: dict[tuple[str, tuple[int, ...], str, str | None, str], int] = {}

    def __getitem__(self, index: int) -> Expression:
        return self.expressions[index]

    def _add(
        self, op: str, operands: tuple[int, ...], kind: str, value: Constant | None = None, origin: str = ""
    ) -> int:
        # repr tells 0.0 from -0.0, and NaN is itself
        key = (op, operands, kind, value if value is None else repr(value), origin)
        index = self._known.get(key)
        if index is None:
            index = len(self.expressions)
            self.expressions.append(Expression(op, operands, kind, value))
            self._known[key] = index
        return index

    def constant(self, value: Constant, kind: str) -> int:
        """A number that is known now."""
        made = {FLOAT: float, INT: int, BOOL: bool}[kind](value)
        return self._add("constant", (), kind, made)

    def held(self, value: float, origin: str, at: Held | None = None) -> int:
        """A number that the function holds, told from others by where it comes from; zeros are constants.

        Args:
            value: The number.
            origin: Where it comes from.
            at: The same, where it is of a tensor that the function is known to hold.
        """
        if value == 0.0:
            return self.constant(value, FLOAT)
        index = self._add("held", (), FLOAT, value, origin)
        self.loose[index] = LOOSE * abs(value)
        if at is not None:
            self.held_at[index] = at
        return index

    def input(self, number: int, kind: str) -> int:
        """The input of this number among those of its kind."""
        return self._add("input", (), kind, number)

    def entry(self, op: str, loop: int, place: int, kind: str) -> int:
        """A scalar of a loop's state: its "variable" within the loop, or its "outcome" afterwards."""
        index = self._add(op, (), kind, origin=f"{loop}.{place}")
        self.entry_of[index] = Entry(loop, place)
        return index

    def returned(self, at: Returned, kind: str) -> int:
        """A scalar that a call of a routine came to."""
        index = self._add("returned", (), kind, origin=f"{at.routine}.{at.call}.{at.place}")
        self.returned_of[index] = at
        return index

    def known(self, index: int) -> Constant | None:
        """What an expression comes to, None where that is not known now."""
        result = self.expressions[index]
        return None if result.op == "input" else result.value

    def number(self, index: int) -> float:
        """The number that a program reads for an expression whose value is known."""
        return float(self.known(index) or 0.0)

    def make(self, op: str, *operands: int) -> int:
        """The expression `op` of the operands, simplified."""
        given = [self.expressions[i] for i in operands]
        values = [None if each.op == "input" else each.value for each in given]
        kind = BOOL if op in _TRUTH else FLOAT if op == "float" else INT if op == "int" else given[-1].kind
        if None not in values and op in FOLDED:
            plain = all(each.op == "constant" for each in given)
            value, loose = folded(op, values, [self.loose.get(i, 0.0) for i in operands])
            if value is not None and not plain and kind == FLOAT and not (value == 0.0 and loose == 0.0):
                index = self._add(op, operands, kind, float(value))
                self.loose[index] = loose
                return index
            index = self._add(op, operands, kind) if value is None else self.constant(value, kind)
            if not plain:
                self.decided[op, operands] = self[index].value
            return index
        shaping = [each.value if each.op == "constant" else None for each in given]
        simpler = self._simplified(op, operands, shaping)
        if simpler is not None:
            return simpler
        if op in COMMUTATIVE and operands[0] > operands[1]:
            operands = operands[::-1]
        return self._add(op, operands, kind)

    def _simplified(self, op: str, operands: tuple[int, ...], values: list[Constant | None]) -> int | None:
        rule = _RULES.get(op)
        return None if rule is None else rule(self, operands, values)


Rule = Callable[[Scalars, tuple[int, ...], list[Constant | None]], int | None]


def _number(value: Constant | None, wanted: float) -> bool:
    return value is not None and value == wanted


def _simpler_sum(scalars: Scalars, operands: tuple[int, ...], values: list[Constant | None]) -> int | None:
    for this, other in ((0, 1), (1, 0)):
        if _number(values[this], 0.0):
            return operands[other]
    for this, other in ((0, 1), (1, 0)):
        if scalars[operands[this]].op == "neg":
            return scalars.make("sub", operands[other], scalars[operands[this]].operands[0])
    return None


def _simpler_difference(scalars: Scalars, operands: tuple[int, ...], values: list[Constant | None]) -> int | None:
    if _number(values[1], 0.0):
        return operands[0]
    if _number(values[0], 0.0):
        return scalars.make("neg", operands[1])
    if scalars[operands[1]].op == "neg":
        return scalars.make("add", operands[0], scalars[operands[1]].operands[0])
    return None


def _simpler_product(scalars: Scalars, operands: tuple[int, ...], values: list[Constant | None]) -> int | None:
    for this, other in ((0, 1), (1, 0)):
        if _number(values[this], 0.0):
            return operands[this]
        if _number(values[this], 1.0):
            return operands[other]
        if _number(values[this], -1.0):
            return scalars.make("neg", operands[other])
    first, second = (scalars[i] for i in operands)
    if first.op == "neg" and second.op == "neg":
        return scalars.make("mul", first.operands[0], second.operands[0])
    for this, other in ((0, 1), (1, 0)):
        if scalars[operands[this]].op == "neg":
            return scalars.make("neg", scalars.make("mul", scalars[operands[this]].operands[0], operands[other]))
    return None


def _simpler_quotient(scalars: Scalars, operands: tuple[int, ...], values: list[Constant | None]) -> int | None:
    return operands[0] if _number(values[1], 1.0) else None


def _simpler_negation(scalars: Scalars, operands: tuple[int, ...], values: list[Constant | None]) -> int | None:
    inner = scalars[operands[0]]
    return inner.operands[0] if inner.op == "neg" else None


def _simpler_choice(scalars: Scalars, operands: tuple[int, ...], values: list[Constant | None]) -> int | None:
    condition, yes, no = operands
    if values[0] is not None:
        return yes if values[0] else no
    if yes == no:
        return yes
    if scalars[condition].op == "not":
        return scalars.make("select", scalars[condition].operands[0], no, yes)
    return None


def _simpler_and(scalars: Scalars, operands: tuple[int, ...], values: list[Constant | None]) -> int | None:
    if operands[0] == operands[1]:
        return operands[0]
    for this, other in ((0, 1), (1, 0)):
        if values[this] is not None:
            return operands[other] if values[this] else operands[this]
    return None


def _simpler_or(scalars: Scalars, operands: tuple[int, ...], values: list[Constant | None]) -> int | None:
    if operands[0] == operands[1]:
        return operands[0]
    for this, other in ((0, 1), (1, 0)):
        if values[this] is not None:
            return operands[this] if values[this] else operands[other]
    return None


def _simpler_not(scalars: Scalars, operands: tuple[int, ...], values: list[Constant | None]) -> int | None:
    inner = scalars[operands[0]]
    return inner.operands[0] if inner.op == "not" else None


_RULES: dict[str, Rule] = {
    "add": _simpler_sum,
    "sub": _simpler_difference,
    "mul": _simpler_product,
    "div": _simpler_quotient,
    "neg": _simpler_negation,
    "select": _simpler_choice,
    "and": _simpler_and,
    "or": _simpler_or,
    "not": _simpler_not,
}
